"""What scripts/attack_files and scripts/crash_recordings share."""
