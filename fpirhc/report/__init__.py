"""Reports: comparisons, studies and reviews on a terminal, as JSON, as figures, and as one HTML file."""
