"""The study of why the flip exists: variants named before they were trained, all of them reported."""
