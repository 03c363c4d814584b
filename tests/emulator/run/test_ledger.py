"""The ledger's sums."""

from emulator.run.outcome import Ledger, LinkLedger


def test_a_sound_run_balances():
    ledger = Ledger(100, 3, 7, 90, (LinkLedger("a", 80, 4, 6), LinkLedger("b", 90, 0, 0)))
    assert ledger.balanced
    assert ledger.dropped_in_device == 6


def test_an_event_without_a_fate_shows():
    assert Ledger(100, 3, 7, 89).imbalance == 1
    assert Ledger(100, 3, 7, 90, (LinkLedger("a", 80, 4, 5),)).imbalance == 1


def test_errors_do_not_cancel():
    assert Ledger(10, 0, 0, 10, (LinkLedger("a", 9, 0, 0), LinkLedger("b", 11, 0, 0))).imbalance == 2
