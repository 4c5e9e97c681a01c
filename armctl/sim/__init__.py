"""A simulated AX-12A arm that speaks the servos' own bytes."""
