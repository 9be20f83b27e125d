"""How one hand is placed and fitted: what is seen of it, the loss, the first guess, a search."""
