"""Logs as they come out of a historian: text, Parquet or frames, to transitions of a plant."""
