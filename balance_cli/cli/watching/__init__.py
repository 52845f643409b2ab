"""The parts of `balance watch`: the folder that is polled, the journal, and the reduction of each run."""
