"""Explicit policies: a small network that does what an MPC does, for where nothing can be solved."""
