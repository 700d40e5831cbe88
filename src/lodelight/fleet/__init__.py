"""Many recordings of one building: a run for each, wherever there is a processor, then one map of them all."""
