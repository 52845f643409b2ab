"""Parts of the loop that finds what a model lacks: candidates, score test, refits, folds, what cannot be told apart."""
