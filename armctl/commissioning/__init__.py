"""Setting an arm up: finding servos, judging them, writing their EEPROM, calibrating the arm. No printing."""
