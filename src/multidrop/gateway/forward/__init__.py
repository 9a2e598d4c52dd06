"""Store and forward: rows are kept on disk until a database or another program has received them."""
