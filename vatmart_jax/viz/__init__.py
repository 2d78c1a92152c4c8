"""Pictures of runs, priors and trials."""
