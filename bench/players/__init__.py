"""Players: programs that simulate lines and drives, and client programs under test."""
