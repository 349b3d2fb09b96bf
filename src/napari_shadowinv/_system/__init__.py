"""Services of Python and the machine: threads, memory, interrupts, locks, checks."""
