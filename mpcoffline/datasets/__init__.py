"""Recording, storing and reading transitions."""
