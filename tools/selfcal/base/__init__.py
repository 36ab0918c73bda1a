"""What every folder knows, and what knows no other folder."""
