"""The packed table of transitions that learning reads."""
