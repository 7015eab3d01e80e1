"""What is known of a run, a job or a study, gathered for a page or a table."""
