"""What searching by gradient buys."""
