"""The buildings, one file each; `sim.scenarios` names them."""
