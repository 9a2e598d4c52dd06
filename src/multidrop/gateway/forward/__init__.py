"""Store and forward: polled values are kept on disk until a database or another program has received them."""
