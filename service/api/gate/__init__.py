"""ASGI middleware in front of the routes: authentication, authorization, rate limits and access log."""
