"""The README's Python runs as pasted."""

import re
from pathlib import Path

README = Path(__file__).parent.parent / "README.md"


def test_python_example(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    shortened, n_substitutions = re.subn(r"learn\([\d_]+", "learn(4096", example)
    assert n_substitutions == 1
    namespace = {}
    exec(shortened, namespace)
    assert namespace["model"].num_timesteps == 4096
    assert list(tmp_path.glob("runs/CChainPPO_1/events*")) and (tmp_path / "acrobot.zip").exists()
