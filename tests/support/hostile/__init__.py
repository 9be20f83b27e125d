"""Files, programs and folders that are damaged, unfinished or mean harm."""
