"""What tools/compose-test goes through. Standard library only."""
