"""Speed against peers: everything timed in one run, so that ratios are fair."""
