"""After training: scores, pictures, films and tables from run directories."""
