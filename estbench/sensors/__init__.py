"""One sensor from its true reading to the delivery of a noisy one."""
