"""What the clients of both versions of dv-processing share: the streams of a camera."""

import time

import dv_processing as dv

KINDS = {
    dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE: 2,
    dv.TriggerType.EXTERNAL_SIGNAL_FALLING_EDGE: 3,
    dv.TriggerType.EXTERNAL_SIGNAL_PULSE: 4,
}


def take(camera, collector, options):
    """Take one packet of each stream that is asked for, or wait for a moment."""
    triggers = camera.getNextTriggerBatch() if hasattr(camera, "getNextTriggerBatch") else ()  # a Micro has no input
    for trigger in triggers or ():
        if trigger.type in KINDS:
            collector.add_trigger(trigger.timestamp, KINDS[trigger.type])
    for one in (camera.getNextImuBatch() or ()) if options.imu else ():
        acceleration_g = one.accelerometerX, one.accelerometerY, one.accelerometerZ
        rate_deg_s = one.gyroscopeX, one.gyroscopeY, one.gyroscopeZ
        collector.add_imu(one.timestamp, *acceleration_g, one.temperature, *rate_deg_s)
    if options.frames and (frame := camera.getNextFrame()) is not None:
        collector.add_frame(frame.timestamp, frame.image)
    batch = camera.getNextEventBatch()
    if batch is None:
        time.sleep(0.001)
        return
    events = batch.numpy()
    collector.add(events["timestamp"], events["x"], events["y"], events["polarity"])


def take_all(camera, collector, options):
    """Take packets until there is enough, or the camera is gone."""
    while not collector.done and camera.isRunning():
        take(camera, collector, options)
