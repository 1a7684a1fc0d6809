"""The optimal value function V from the log alone: (VALUE) and its better forms."""
