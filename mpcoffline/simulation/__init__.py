"""Models of a log, and closed loops on them."""
