"""Which of the effects found are kept, and what supports them."""
