"""Players: lines, drives and clients under attack."""
