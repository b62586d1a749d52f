"""The REST API: routes, views with units, errors as problem+json, server-sent events."""
