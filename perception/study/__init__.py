"""Why the flip exists: variants that were named before they were trained, all of them reported."""
