"""
Silences the notice that the old ``gym`` prints when it is imported: ProcGen brings it, and Stable-Baselines3 imports it if it
is installed. Import this module before Stable-Baselines3.
"""

from contextlib import suppress

with suppress(ImportError):
    from gym_notices.notices import notices

    notices.clear()
