"""Long statistical studies: what the estimators promise, measured on simulated campaigns (`make study`)."""
