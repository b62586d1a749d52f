"""REST over the jobs: routes, views with units, errors as problem+json, server-sent events."""
