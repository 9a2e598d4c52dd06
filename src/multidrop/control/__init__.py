"""Control: everything that is written to a drive, and every stop."""
