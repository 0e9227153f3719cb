"""Reports: what a comparison looks like on a terminal, as JSON, as figures, and as one HTML file."""
