"""What is measured, a file each: `run` adds what it found to the results."""
