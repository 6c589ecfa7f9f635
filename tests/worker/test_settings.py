from pathlib import Path

import pytest
from pydantic import ValidationError

from worker.settings import Settings


@pytest.fixture(autouse=True)
def no_variables(monkeypatch, tmp_path):
    import os

    for name in os.environ:
        if name.startswith("SOFTMAPS_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))


def test_every_setting_is_described():
    undocumented = [name for name, field in Settings.model_fields.items() if not field.description]
    assert not undocumented


def test_a_variable_is_the_capitalised_name_after_the_prefix(monkeypatch):
    monkeypatch.setenv("SOFTMAPS_MAX_QUEUED", "7")
    monkeypatch.setenv("SOFTMAPS_REDIS_URL", "redis://elsewhere:1")
    assert Settings().max_queued == 7
    assert Settings().redis_url == "redis://elsewhere:1"


def test_an_empty_variable_counts_as_unset(monkeypatch):
    monkeypatch.setenv("SOFTMAPS_THREADS", "")
    monkeypatch.setenv("SOFTMAPS_TOKEN", "")
    assert Settings().threads is None
    assert Settings().token is None


@pytest.mark.parametrize(
    ("name", "value"),
    [("THREADS", "0"), ("MAX_QUEUED", "many"), ("MAX_COST_SECONDS", "inf"), ("STORE_MAX_BYTES", "-1")],
)
def test_an_impossible_value_is_refused(monkeypatch, name, value):
    monkeypatch.setenv(f"SOFTMAPS_{name}", value)
    with pytest.raises(ValidationError, match=name.lower()):
        Settings()


def test_no_file_is_read(monkeypatch, tmp_path):
    (tmp_path / ".env").write_text("SOFTMAPS_MAX_QUEUED=7\n")
    monkeypatch.chdir(tmp_path)
    assert Settings().max_queued == 1_000


def test_the_data_folder_is_absolute_wherever_a_child_runs(monkeypatch, tmp_path):
    assert Settings().data == tmp_path / "softmaps"
    monkeypatch.chdir(tmp_path)
    assert Settings(data=Path("here")).store_folder == tmp_path / "here" / "store"
    assert Settings(data=Path("~/there")).redis_folder == Path.home() / "there" / "redis"


def test_settings_are_frozen_and_closed():
    with pytest.raises(ValidationError, match="frozen"):
        Settings().max_queued = 2
    with pytest.raises(ValidationError, match="max_queue"):
        Settings(max_queue=2)


def test_the_token_is_never_shown(monkeypatch):
    monkeypatch.setenv("SOFTMAPS_TOKEN", "hunter2")
    settings = Settings()
    assert settings.token is not None
    assert settings.token.get_secret_value() == "hunter2"
    assert "hunter2" not in repr(settings)
