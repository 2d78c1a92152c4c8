"""What conversion leaves for training: banks, splits, the cache."""
