"""Live scenes without a browser: sessions, their clients and what files show."""
