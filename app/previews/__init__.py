"""Small still and moving pictures of sequences and runs, made beside the server and kept."""
