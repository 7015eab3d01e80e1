"""`aegis push`: upload a trained policy with its model card as a model repository of the hub.

An export of `aegis export` is sent as it is, whether or not its card was edited.
"""

from __future__ import annotations

import contextlib
import importlib.util
import re
import tempfile
from collections.abc import Generator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aegis_cli.common import commands
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.common.files import write_text
from aegis_cli.common.version import __version__
from aegis_cli.models import lerobot_folder
from aegis_cli.models.backbones.base import FLOAT32
from aegis_cli.publishing import card, export
from aegis_cli.training import checkpoint

if TYPE_CHECKING:
    from huggingface_hub import HfApi

_REPO = re.compile(r"(?![-.])[\w.-]+(?<![-.])/(?![-.])[\w.-]+(?<![-.])", re.ASCII)
# Files in `backbone/` after a push: the model's files and its card, and transformers' names for the
# files of a processor. A leftover file of another backbone would be loaded with the new one.
_OF_BACKBONE = {
    "README.md",
    "config.json",
    "generation_config.json",
    "aegis.json",
    "processor_config.json",
    "preprocessor_config.json",
    "video_preprocessor_config.json",
    "audio_tokenizer_config.json",
    "tokenizer.json",
    "tokenizer_config.json",
    "special_tokens_map.json",
    "added_tokens.json",
    "vocab.json",
    "vocab.txt",
    "merges.txt",
    "chat_template.json",
    "chat_template.jinja",
    "tokenizer.model",
    "tiktoken.model",
    "tekken.json",
    "spiece.model",
    "sentencepiece.model",
    "sentencepiece.bpe.model",
}
_TEMPLATES = "additional_chat_templates"  # a processor's only subfolder
_NOBODYS = re.compile(r"\bORG/[\w-]+(?:\.[\w-]+)*")  # the repository's placeholder on a card
_LONGEST = 96  # characters of a repository's name, by the hub's rules
_NO_TOKEN = "hf auth login, or set HF_TOKEN to one of https://huggingface.co/settings/tokens"


@dataclass(frozen=True)
class PushReport:
    """What was sent where, or would be.

    Attributes:
        format: `aegis`, a checkpoint without its training state, or `lerobot`.
        dtype: name of the dtype of the backbone's weights.
        url: the commit's; None if nothing was sent.
        files: their paths in the repository.
        removed: paths of an earlier policy of ours that the new one lacks; not known for a dry run.
        megabytes: the sizes of `files` together.
    """

    repo: str
    url: str | None
    format: str
    dtype: str
    private: bool
    files: tuple[str, ...]
    removed: tuple[str, ...]
    megabytes: float

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    run_path: Path,
    repo: str,
    form: str | None = None,
    private: bool = False,
    dry_run: bool = False,
    dtype: str = export.SOURCE,
    on_event: OnEvent = ignore,
) -> PushReport:
    """Send the policy of a run, of a checkpoint in a run, or of an export to the hub in one commit.

    A missing repository is created. Files that an earlier push has left, in either layout or with
    another backbone, are removed, since they would be loaded instead of the new policy or with it;
    all other files stay.

    Args:
        repo: ORG/NAME.
        form: `aegis` or `lerobot`; None: `aegis` for a run, and an export's own layout.
        private: create a private repository, and refuse one that is public.
        dry_run: check everything that needs no network, and send nothing.
        dtype: dtype of the backbone's weights, as for `export.run`.

    Raises:
        AegisError: neither a run of a policy nor an export, a damaged one, an invalid name, no
            token, or a hub that cannot be reached or refuses.
    """
    _check_name(repo)
    export.refuse_stream(run_path)
    is_exported = _is_exported(run_path)
    if is_exported:
        form = _own_form(run_path, form, dtype)
    else:
        _check_in_a_run(run_path, repo)
        export.warn_of_steps_left(run_path, "push", on_event)
        export.warn_of_a_merge(run_path, "push", on_event)
    # Before the export, which takes minutes, since nothing can be sent without a token.
    api = None if dry_run else _api()
    with tempfile.TemporaryDirectory() as aside:
        form, folder = form or card.AEGIS, Path(aside) / "policy"
        if is_exported:
            contents, dtype = _as_it_is(run_path, repo, folder)
        else:
            at = checkpoint.chosen(run_path)
            dtype = export.run(at, folder, form, repo=repo, dtype=dtype).dtype
            contents = _files(folder)
        url, removed = (None, ()) if api is None else _send(api, repo, contents, private)
        size = sum(path.stat().st_size for path in contents.values())
        files = tuple(sorted(contents))
        return PushReport(repo, url, form, dtype, private, files, removed, size / 1e6)


# --- what is sent ---------------------------------------------------------------------------------


def _is_exported(folder: Path) -> bool:
    """Whether a folder is a run's export by `aegis export`: a policy with its card."""
    if not (folder / card.NAME).is_file():
        return False
    if lerobot_folder.is_policy(folder):
        return True
    # A checkpoint that was copied out of its run still has its training state.
    is_plain = checkpoint.is_one(folder) and not (folder / checkpoint.STATE).exists()
    return is_plain and checkpoint.run_of(folder) is None


def _own_form(folder: Path, form: str | None, dtype: str) -> str:
    """The layout of an exported folder.

    Raises:
        AegisError: another layout or another dtype of weights is requested.
    """
    own = card.LEROBOT if lerobot_folder.is_policy(folder) else card.AEGIS
    asked = f"--dtype {dtype}" if dtype != export.SOURCE else ""
    if form not in (None, own):
        asked = f"--format {form}"
    if asked:
        raise AegisError(
            f"{asked} for '{folder}', which was exported with --format {own}",
            "an exported policy as it is",
            f"leave {asked.partition(' ')[0]} out, or give the run's folder",
        )
    return own


def _check_in_a_run(path: Path, repo: str) -> None:
    """Raise AegisError for a policy outside a run, for which no model card can be made."""
    if lerobot_folder.is_policy(path) or checkpoint.run_of(checkpoint.chosen(path)) is None:
        raise AegisError(
            f"'{path}', a policy outside of its run and without {card.NAME}",
            "a run, whose recipe and results make the model card, or what aegis export wrote",
            "give the run's folder, or send this one without a card: "
            f"{commands.shell('hf', 'upload', repo, path)}",
        )


def _as_it_is(folder: Path, repo: str, aside: Path) -> tuple[dict[str, Path], str]:
    """The files of an exported folder, and the dtype of its backbone's weights.

    Args:
        aside: a folder to create for the card, in whose commands the repository's name is filled.

    Raises:
        AegisError: a damaged policy, or a card that is not text.
    """
    meta, own = checkpoint.load_policy(folder)[1], folder / card.NAME
    try:
        text = own.read_text(encoding="utf-8")
    except ValueError as error:
        raise AegisError(f"'{own}' is no UTF-8", "a model card", "save it as UTF-8") from error
    aside.mkdir()
    told = aside / card.NAME
    write_text(told, _NOBODYS.sub(repo, text))
    return {**_files(folder), card.NAME: told}, meta.get("stored", FLOAT32)


def _check_name(repo: str) -> None:
    fine = _REPO.fullmatch(repo) and len(repo) <= _LONGEST
    if not fine or "--" in repo or ".." in repo or repo.endswith(".git"):
        raise AegisError(
            f"the repository '{repo}'",
            "ORG/NAME of letters, digits, '-', '_' and '.', without '--' and '..'",
            "e.g. aegis push runs/x your-name/reach-aegis",
        )


def _files(folder: Path) -> dict[str, Path]:
    """The files below a folder by their relative paths, except hidden ones such as git's."""
    found = {}
    for path in folder.rglob("*"):
        own = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in own.parts):
            found[own.as_posix()] = path
    return found


# --- the hub --------------------------------------------------------------------------------------


def _api() -> HfApi:
    """The hub's client, with a token.

    Raises:
        AegisError: the client is not installed, or has no token.
    """
    if importlib.util.find_spec("huggingface_hub") is None:
        raise AegisError(
            "no package 'huggingface_hub'", "the hub's client", "pip install 'aegis-vla[hub]'"
        )
    import huggingface_hub

    if huggingface_hub.get_token() is None:
        raise AegisError("no token of the hub", "one that may write", _NO_TOKEN)
    return huggingface_hub.HfApi(library_name="aegis-vla", library_version=__version__)


def _send(
    api: HfApi, repo: str, contents: Mapping[str, Path], private: bool
) -> tuple[str, tuple[str, ...]]:
    """Create the repository if it is missing, and commit the files.

    Returns:
        The commit's URL, and which files it removes.
    """
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete

    added = [CommitOperationAdd(path, content) for path, content in sorted(contents.items())]
    with _reaching(repo):
        # None leaves the choice to the organisation, which may make all repositories private.
        api.create_repo(repo, private=private or None, exist_ok=True)
        # `exist_ok` also accepts an existing public repository.
        if private and not api.repo_info(repo).private:
            raise AegisError(
                f"--private for '{repo}', which is there and public",
                "a private repository, or a new one",
                "choose another name, or make it private in its settings",
            )
        removed = _of_an_earlier_push(api, repo, contents)
        changes = [*added, *(CommitOperationDelete(path) for path in removed)]
        # One commit, so that nobody can load the new policy with a part of the old one.
        message = f"A policy of Aegis {__version__}"
        commit = api.create_commit(repo, changes, commit_message=message)
    return commit.commit_url, removed


def _of_an_earlier_push(api: HfApi, repo: str, contents: Mapping[str, Path]) -> tuple[str, ...]:
    """The files of an earlier push, in either layout, that this one lacks."""
    siblings = api.model_info(repo).siblings or []
    there = {file.rfilename for file in siblings}
    left = set[str]()
    if {lerobot_folder.CONFIG, lerobot_folder.MODEL} <= there:
        # Other policies and models also have files with these names.
        config = Path(api.hf_hub_download(repo, lerobot_folder.CONFIG))
        if lerobot_folder.is_own_config(config.read_bytes()):
            left |= {lerobot_folder.CONFIG, lerobot_folder.MODEL}
            left |= {lerobot_folder.PREPROCESSOR, lerobot_folder.POSTPROCESSOR}
    if checkpoint.EXPERT in there:  # a checkpoint of ours
        left |= {checkpoint.EXPERT, export.RECIPE}
    if left:  # a policy of ours was there, and so is a `backbone/` of ours
        left |= {path for path in there if _is_of_a_backbone(path)}
    return tuple(sorted((left & there) - set(contents)))


def _is_of_a_backbone(path: str) -> bool:
    """Whether this is a path that Aegis writes in the folder of a policy's backbone."""
    folder, _, name = path.partition("/")
    if folder != checkpoint.BACKBONE:
        return False
    below, _, last = name.rpartition("/")
    if below:
        return below == _TEMPLATES and last.endswith(".jinja")
    return name in _OF_BACKBONE or name.endswith(".safetensors")


@contextlib.contextmanager
def _reaching(repo: str) -> Generator[None]:
    """Turn errors of the hub or the network into the one error that a user sees."""
    from huggingface_hub.errors import HfHubHTTPError, HTTPError, OfflineModeIsEnabled

    try:
        yield
    except OfflineModeIsEnabled as error:
        fix = "unset HF_HUB_OFFLINE, or see what would be sent with --dry-run"
        raise AegisError("HF_HUB_OFFLINE, which forbids the network", "a network", fix) from error
    except HfHubHTTPError as error:
        raise _refused(repo, error) from error
    except ValueError as error:  # from the card's head, which the hub checks first
        found = " ".join(str(error).split())
        fix = f"correct what stands between the lines --- of {card.NAME}; nothing was committed"
        raise AegisError(found, "a model card whose head is sound YAML", fix) from error
    except (HTTPError, OSError) as error:  # a failed connection or a timeout
        said = str(error) or type(error).__name__
        raise AegisError(
            f"the hub cannot be reached: {said.splitlines()[0]}",
            "a network, and a hub that answers",
            "try again later; nothing was committed",
        ) from error


def _refused(repo: str, error: Any) -> AegisError:
    """The error for an unsuccessful response of the hub."""
    status = error.response.status_code
    said = (getattr(error, "server_message", None) or str(error)).strip().splitlines()[0]
    # The hub answers 404 to users who may not see a repository.
    found = f"the hub refuses '{repo}' ({status}): {said}"
    if status == 401:
        return AegisError(found, "a token that is valid", _NO_TOKEN)
    if status in (403, 404):
        fix = "hf auth whoami says who you are; take a token with write access to ORG"
        return AegisError(found, "a token that may write there", fix)
    return AegisError(found, "a hub that takes the files", "try again later; nothing was committed")
