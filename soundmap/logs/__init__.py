"""From a recorded log to what the sensors measured."""
