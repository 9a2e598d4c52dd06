"""Ports, and exchanges on them."""
