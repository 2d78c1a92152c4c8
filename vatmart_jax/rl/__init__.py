"""TD3 with hindsight: knows states, actions and rewards; neither physics nor files."""
