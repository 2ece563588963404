"""Hardware evaluation: entries on a physical lung, through a wire protocol with a safe device.

The package uses ventbench; ventbench never imports it. ``PROTOCOL.md`` specifies the wire.

The host holds a :class:`~hardware_eval.wire.client.Client`. It talks either through a
:class:`~hardware_eval.wire.client.Link` (a serial port, a socket, the emulator's pseudo-terminal),
or to a :class:`~hardware_eval.emulation.emulator.LoopbackDevice`, which runs the device's program
in the same process on a virtual clock, faster than real time::

    from hardware_eval.wire.client import Client
    from hardware_eval.emulation.emulator import LoopbackDevice
    from hardware_eval.emulation.simulated import simulated_lung

    device = LoopbackDevice(simulated_lung("R20C50"))
    client = Client(device, device.clock)
    welcome = client.hello()  # session, identity, limits; the lung is vented
    client.arm()  # from here on the watchdog waits for commands
    for step in range(34):
        reading = client.heartbeat()  # a fresh pressure, no effect on the valves
        client.command(10.0, 0)  # u_in 10 %, expiratory valve closed
        device.clock.sleep_until(device.start + (step + 1) * 0.03)
    client.vent()
"""
