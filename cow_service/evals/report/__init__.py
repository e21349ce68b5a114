"""Tables, plots and a page of runs."""
