"""Many runs in one call: executors, the order of results, the journal of what is done, shards."""
