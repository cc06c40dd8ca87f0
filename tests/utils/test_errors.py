import pickle

import pytest

from curvireg_torch import errors


@pytest.mark.parametrize(
    "name", [name for name in vars(errors) if name.endswith(("Error", "Warning")) and name[0] != "_"]
)
def test_errors_keep_message_and_subject(name: str) -> None:
    error = getattr(errors, name)("unusable; use another", subject="a.png")
    for copy in (error, pickle.loads(pickle.dumps(error)), type(error)("unusable; use another").with_subject("a.png")):
        assert str(copy) == "a.png: unusable; use another"
        assert (copy.message, copy.subject) == ("unusable; use another", "a.png")
    assert str(error.with_subject("image 3")) == "image 3: unusable; use another"
    assert str(type(error)("unusable")) == "unusable"
