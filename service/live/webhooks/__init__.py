"""Webhooks: others are called when a job awaits a decision or has ended, by threads of their own."""
