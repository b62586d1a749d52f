"""Identification turns a record into a model, or gives the reason why the record does not determine one."""
