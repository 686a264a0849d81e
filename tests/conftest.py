import os
import signal

# A shell starts what it runs in the background with Ctrl-C ignored, and so would the commands be
# that the tests start and interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Threads of BLAS would compete with the tests that run beside this one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

from tests import typecheck

typecheck.install()

settings.register_profile(
    "estbench", derandomize=True, max_examples=50, deadline=None, database=None
)
settings.load_profile("estbench")


@pytest.fixture(autouse=True)
def _check_shapes(request):
    typecheck.begin_test(request.node.nodeid.partition("[")[0])
