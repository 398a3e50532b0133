"""Commands and moves: what a program tells a simulated arm or a robot, and how it is carried out."""
