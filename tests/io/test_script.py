import os
import signal
import time

from tests.errors import refuses
from warmprior.io.script import run_script


def test_ctrl_c_is_one_line_whatever_becomes_of_it(capsys):
    def script():
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        except KeyboardInterrupt as error:  # as libraries do that say where it happened
            raise RuntimeError("in the forward pass") from error

    before = signal.getsignal(signal.SIGINT)
    assert run_script(script, "a.py", hint="--resume continues") == 130
    assert capsys.readouterr().err == "\na.py: interrupted; --resume continues\n"
    assert signal.getsignal(signal.SIGINT) is before


def test_errors_of_ours_are_not_hidden():
    def script():
        raise TypeError("a defect")

    refuses(lambda: run_script(script, "a.py"), TypeError, "a defect")
