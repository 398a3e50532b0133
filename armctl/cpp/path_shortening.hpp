// Shorter paths of lines that are proved free. Source: R. Geraerts, M. H. Overmars, "Creating high-quality paths for motion
// planning", IJRR 26 (2007).
#pragma once
#include "free_space.hpp"
#include "spans.hpp"

namespace armctl {

// Goes from each point of a path straight to the farthest one that can be reached.
void drop_needless_points(FreeSpace& space, Path& path);

// Goes straight between pairs of random places, (k, 2) shares of the path's length.
void take_shortcuts(FreeSpace& space, Path& path, Matrix places);

}  // namespace armctl
