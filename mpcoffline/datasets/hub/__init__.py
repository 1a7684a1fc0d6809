"""Data sets elsewhere: downloads and uploads."""
