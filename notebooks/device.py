# %% [markdown]
# # A set on a device: send it, press it, look at force and position
# The device is simulated here: the firmware's code, with an actuator, an encoder and a finger, in a separate
# process. Its time is that of this notebook ("lockstep"): it passes while the notebook waits for telemetry. With a real
# device, put its port in place of "sim", and leave the options out.

# %%
import jax

jax.config.update("jax_enable_x64", True)

import os

import numpy as np

from hilbo.device.reasons import SampleFlag
from hilbo.errors import InputError
from hilbo.hardware_bridge import Renderer
from hilbo.viscoelastic import FOSLS

device = Renderer.open("sim", options={"finger": "none", "rate": "lockstep"})
said = device.device
print(
    f"damping {said.damping_N_s_per_m:.3f} N.s/m, at most {said.force_limit_N:g} N, {said.tick_rate_Hz} ticks a second"
)
print(f"stroke {said.position_low_mm:.1f} to {said.position_high_mm:.1f} mm in steps of {said.encoder_step_mm:.4f} mm")

# %% [markdown]
# ## Send a set
# The paper's aggregate parameters. The device checks them again with its own damping; the returned values are those of
# the active set, bit for bit those that were sent.

# %%
confirmed = device.send(K0=-3.18, K1=5.58, B1=7.88, alpha=0.176)
print(confirmed)
print(f"needs {confirmed.needs:.4f} N.s/m of damping, has {said.damping_N_s_per_m:.4f}")

# %% [markdown]
# A set that is not passive on this device is rejected, and the active one stays.

# %%
try:
    device.send(K0=-5.01, K1=8.44, B1=10.28, alpha=0.282)
except InputError as error:
    print(error)
print("in force:", device.in_force() == confirmed)

# %% [markdown]
# ## Press
# A simulated finger presses in and oscillates at 2 Hz. On a real device, use your finger.

# %%
seconds = 3.0 if "HILBO_NOTEBOOK_TRIALS" in os.environ else 10.0
device.start()
device.simulator.tell("finger sine")
table = device.telemetry(seconds)
print(table.describe().loc[["min", "mean", "max"], ["position_mm", "force_N", "sensed_N"]].round(3))
print("marks:", [flag.name for flag in SampleFlag if np.any(table["flags"] & int(flag))])

# %% [markdown]
# ## Change the set while the finger is there
# The new set first fills its history, then takes over; the difference fades out under the slew limit.

# %%
device.send(K0=-2.89, K1=5.70, B1=5.89, alpha=0.203)
after = device.telemetry(1.0)
steps = np.abs(np.diff(after["force_N"]))
print(f"largest step of force {steps.max():.3f} N, slew limit {said.slew_limit_N_per_s * device.tick_s:.3f} N a tick")

# %% [markdown]
# ## Stop
# A real device gets its heartbeats from a separate process, so that computations of any length do not stop it; the
# force ends when the notebook ends or hangs. The presentation is over, therefore the device is stopped.

# %%
device.stop()
print(device.state().name, device.events())
device.close()

# %% [markdown]
# ## Compare
# The same positions through `viscoelastic`, in double precision. Out of contact the model sees 0 and pushes nothing.

# %%
model = FOSLS(confirmed.K0, confirmed.K1, confirmed.B1, confirmed.alpha, N=confirmed.length)
expected = np.asarray(model.simulate(np.maximum(table["position_mm"].to_numpy(), 0), unilateral=True))
error = np.abs(table["force_N"].to_numpy() - expected)
print(f"largest force {expected.max():.3f} N, largest difference {error.max():.2e} N")

# %% [markdown]
# ## See it

# %%
import matplotlib.pyplot as plt

figure, (top, bottom) = plt.subplots(2, sharex=True, figsize=(8, 5), layout="constrained")
top.plot(table["time_s"], table["force_N"], label="device")
top.plot(table["time_s"], expected, "--", label="viscoelastic")
top.set_ylabel("force (N)")
top.legend()
bottom.plot(table["time_s"], table["position_mm"])
bottom.set_ylabel("position (mm)")
bottom.set_xlabel("time (s)")
plt.show()
