"""The blind suite: can the search for a missing effect be trusted?

The synthetic robot (plain C MuJoCo, another time step, its own formulas) hides something, or nothing; the search
gets the recordings and must say what.  Nobody who tunes the search sees the scored cases beforehand:

* `make` writes recordings into OUT/cases/<scene>_<digits>/ and the truth into OUT/sealed/.  The search runs in a
  process of its own that is given the former alone; `score` opens the seals.
* Seeds derive from the hash of the commit that froze the method: int(sha256(commit + name of the case)[:8], 16).
  `--commit development` draws cases to tune with.
* Detection limits are computed (`limits`) and committed before that; amplitudes are 1, 3 and 10 times the limit
  (or the size that the library calls worth naming, where that is larger).

Usage, from the root of the checkout:

    python experiments/hidden_effects.py make --commit development --scenes bench --out runs/dev
    python experiments/hidden_effects.py make --commit development --scenes hinge --effects closer --classes single
    python experiments/hidden_effects.py search runs/dev/cases --results runs/dev/results    # goes on where it was
    python experiments/hidden_effects.py search runs/dev/cases/bench_3fa91c02 --results runs/dev/results  # one case
    python experiments/hidden_effects.py score --out runs/dev                     # runs/dev/hidden_effects.json

A result is a file; deleting one runs its case again.  Within a process the replays of a
scene are compiled once.

Every case draws: the robot's and the door's nuisances from their priors (door pose 2 mm and 0.5 degree, knob
1 mm, link masses and servo gains 3 %, clock 1 ms), torque offsets that DIFFER between the recordings of a case,
start poses, coloured torque noise, angle noise at 30 Hz.

Nulls by the hundred, screened only: experiments/null_calibration.py.

scenes, door_motion   where
draws, cases, make    what is hidden, and how it is recorded
answers               which names are right, and which ties are declared
search, baselines     the part that knows nothing, and simpler methods on the same base fit
score, rates, table   what is right of each answer, the rates and their intervals, and these as a table
units, marks, forms, limits   what a hidden effect leaves in the torques, whose it could be, and whether it is seen
"""
