"""What every method that maps positions to pixels shares."""
