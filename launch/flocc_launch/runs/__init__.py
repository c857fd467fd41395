"""Run folders: what drivers write, and what reports, doctor, dashboard and views read."""
