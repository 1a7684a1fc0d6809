"""The field side by side: what other offline learners and plain MPCs make of the same logs."""
