"""What a running server and those who look at it say to each other: state, requests, events, client."""
