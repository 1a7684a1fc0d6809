"""Looking after what is stored: repair, replay, cleaning up."""
