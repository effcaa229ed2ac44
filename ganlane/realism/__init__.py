"""The realism card, and its command: how close a traffic comes to recorded driving.

    ganlane realism traffic=gan_calibrated
    ganlane realism traffic=gan data.path=recordings.csv 'against=[idm_mobil,gan_calibrated]'
    ganlane realism traffic=idm traffic._target_=my.module.MyTraffic vehicle_km=100
    ganlane realism traffic=gan_calibrated scenes=all long_against=true
    ganlane realism traffic=idm quick=true

Writes results.json, distributions.png and distances.png into its run folder. Without
recordings on the machine it uses the histograms that ship, and says so.

Every traffic of a card drives from the same starts: the recorded scenes, for as long as they were
recorded. Simulated and recorded trajectories go through the same measurement. Each quantity gets
the distance between both distributions, with an interval over scenes, on a scale with two ends: one
half of the recordings against the other, and random driving. Long runs without an ego show what a
traffic does over minutes.

Modules, from the bottom up:

- :mod:`~ganlane.realism.measures`: what is measured of trajectories, the distance of two
  distributions, and the histograms that ship.
- :mod:`~ganlane.realism.driving`: a traffic drives recorded scenes; reference drivers.
- :mod:`~ganlane.realism.long_runs`: long runs, and the events in them.
- :mod:`~ganlane.realism.starts`: every traffic from recorded or spawned starts, its desired speeds
  fitted, by folds where asked for.
- :mod:`~ganlane.realism.card`: a card's numbers.
- :mod:`~ganlane.realism.sheets`: the same as tables and figures.
"""
