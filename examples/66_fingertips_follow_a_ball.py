"""Four fingertips of a hand hold a ball and go with it, within the limits of speed and acceleration of 16 joints."""

import numpy as np

import armctl

hand = armctl.load("wonik_allegro")
places = {tip: hand.fk(hand.home, tip).position for tip in hand.tips}  # on the ball, at the start

ik = armctl.DifferentialIk(hand)
q = hand.home
dt = 0.002
farthest = 0.0
for k in range(3000):
    t = k * dt
    moved = np.array([0.0, 0.0, 0.01 * (np.cos(2.0 * t) - 1.0)])
    q = q + dt * ik.step(q, {tip: place + moved for tip, place in places.items()}, dt)
    misses = [np.linalg.norm(hand.fk(q, tip).position - place - moved) for tip, place in places.items()]
    farthest = max(farthest, *misses)
print(f"{len(hand.tips)} fingertips, {hand.n} joints: at most {1e3 * farthest:.2f} mm from their places on the ball")
