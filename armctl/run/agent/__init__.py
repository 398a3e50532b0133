"""A language model commands an arm: its tools, the person who lets it move a robot, and the server of the protocol."""
