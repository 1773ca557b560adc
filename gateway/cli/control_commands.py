"""The command that speaks to a running gateway: control."""

from enum import Enum
from typing import Annotated

import typer

from gateway.cli.terminal import EXIT_NO, ConfigArgument, JsonOption, complain, print_json, results

CONTROL_EPILOG = """Examples, while a run of paper is going on in another terminal:

\b
  drive-gateway control paper override 50        half speed
  drive-gateway control paper override 110       faster than configured, as far as the limits of both axes go
  drive-gateway control paper override 0         stand, on the cam, and wait
  drive-gateway control paper jog -- -6          back at 6 rpm; jog 0 stands again; override 100 goes on
  drive-gateway control paper phase-shift 5      the slave 5 deg of the master ahead on its cam
  drive-gateway control paper disengage 200      the slave leaves its cam where the master is at 200 deg
  drive-gateway control paper engage 200 --json
  drive-gateway control paper window 45          from now on it leaves and returns within 45 deg; 0: what fits best

Every order is proved against the axes' limits and the singular positions first; a refusal says why, with status 1.
"""


class OrderName(Enum):
    """Orders as they are typed."""

    OVERRIDE = "override"
    JOG = "jog"
    PHASE_SHIFT = "phase-shift"
    DISENGAGE = "disengage"
    ENGAGE = "engage"
    WINDOW = "window"


def control(
    config: ConfigArgument,
    order: Annotated[
        OrderName, typer.Argument(metavar="ORDER", help="override, jog, phase-shift, disengage, engage or window.")
    ],
    value: Annotated[float, typer.Argument(metavar="VALUE", help="Per cent, rpm, or degrees of the master.")],
    as_json: JsonOption = False,
) -> None:
    """Change the speed of a running machine, jog it, shift its phase, or take the slave off its cam and back."""
    from config.loading import load_config
    from gateway.cyclic.operation import Order
    from gateway.running.control import send_order

    answer = send_order(load_config(config).name, Order[order.name], value)
    if as_json:
        print_json({key: answer[key] for key in ("order", "value", "refusal")})
    if answer["refusal"]:
        complain([str(answer["text"])], EXIT_NO)
    if not as_json:
        results().print(str(answer["text"]), soft_wrap=True, markup=False)
