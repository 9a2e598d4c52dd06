"""Players: programs that simulate lines and drives, and clients to be attacked."""
