"""The AX-12A servo and its half-duplex bus, protocol 1.0."""
