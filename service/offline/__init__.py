"""What needs neither a loop nor a service: models, tunings, recorded tests."""
