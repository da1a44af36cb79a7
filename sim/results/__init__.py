"""What a sortie leaves behind: the record, the outcome, the run's folder, tables and pages."""
