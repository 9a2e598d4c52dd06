"""Everything that is written to a drive."""
