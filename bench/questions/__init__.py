"""Scripts that each answer one question by measurements, in folders by topic."""
