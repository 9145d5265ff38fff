"""How far the array's clock and its mount are off, from the run itself."""
