"""What panels show, as arrays and words: no Qt in here."""
