"""From a record to a model, or the reason why the record does not determine one."""
