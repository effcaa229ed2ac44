"""A GPU, seen on a pretended one: where the tensors are, and for what the host waits."""

import json
from pathlib import Path

import pytest
from reference.processes import run
from torch.utils import backend_registration

PROGRAM = Path(__file__).parent / "reference" / "pretend_gpu.py"
#: TorchRL asks whether any row has ended.
RESET = {"_local_scalar_dense in torchrl/envs/common.py _reset_check_done": 3}
#: An action out of range is told to the user.
DECISION = {"copy to the host in ganlane/env/state.py checked_action": 1}
#: The rows of the parts have to be known.
ROWS = {"tolist in ganlane/traffic/mixed.py rows_of_parts": 1}
TRAINING = {
    "collect": {
        **DECISION,
        "_local_scalar_dense in torchrl/envs/common.py any_done": 1,
        "_local_scalar_dense in torchrl/envs/common.py maybe_reset": 1,
    },
    # TorchRL's writer counts on the host.
    "store": {
        "copy from the host in tensordict/base.py to": 1,
        "synchronize in tensordict/base.py _sync_all": 1,
        "copy from the host in ganlane/agents/replay.py update_priority": 1,
    },
    "update": {},
    "elsewhere": [],
}

#: Experimental in PyTorch.
pytestmark = pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="this PyTorch has no devices written in Python",
)


def test_a_decision_of_all_traffics_and_a_training_stay_on_the_gpu_and_wait_for_what_is_listed():
    done = run(str(PROGRAM))
    assert done.returncode == 0, done.stderr[-3000:]
    report = json.loads(done.stdout.splitlines()[-1])
    mixed = {"reset": RESET | ROWS, "decision": DECISION | ROWS, "elsewhere": []}
    assert report == {"mixed": mixed, "training": TRAINING}
