"""For the tests of others: a pytest plugin, rigs that run beside a test, ports in memory, and contract suites."""
