"""API keys, and the identity of the caller of a request."""
