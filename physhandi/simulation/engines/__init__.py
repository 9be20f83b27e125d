"""Ways to run the same substeps: graphs of launches, one launch a frame, threads, batches."""
