"""Live simulation: the client in the server, the worker process, and the rollouts between them."""
