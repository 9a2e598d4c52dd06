"""Questions about recordings, captures, histories and family files."""
