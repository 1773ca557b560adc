"""Orders to a running gateway from another process, through its ring."""

import time
from typing import Any, Final

from gateway.cyclic.operation import Order
from gateway.errors import GatewayError
from gateway.record.ring import attach

PATIENCE_S: Final = 2.0
POLL_S: Final = 0.01


def send_order(name: str, order: Order, value: float) -> dict[str, Any]:
    """Send an order to the run called ``name``, and give the event that answers it (``refusal`` is empty if taken).

    Raises GatewayError where no such run is going on, or it does not answer.
    """
    with attach(name) as reader:
        reader.read_new_events()
        try:
            reader.send_order(int(order), value)
        except ValueError as error:
            raise GatewayError(f"{order.name.lower()}: {error}") from None
        give_up_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < give_up_s:
            for event in reader.read_new_events()[0]:
                if event.data.get("kind") == "order":
                    return dict(event.data)
            if reader.is_over():
                raise GatewayError(f"the run of {name} has ended")
            time.sleep(POLL_S)
    raise GatewayError(f"the run of {name} has not answered within {PATIENCE_S:g} s")
