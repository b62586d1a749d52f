"""The procedure that moves MV by a relay."""
