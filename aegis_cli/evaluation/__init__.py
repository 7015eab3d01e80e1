"""What a trained policy still knows, how well it acts, and what it costs."""
