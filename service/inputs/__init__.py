"""Input from users: the configuration of the loops, requests and models as JSON, and their validation."""
