"""Physics engines of others, which give the truth that a fit is scored against."""
