// Measures one point: what the cameras of a table see of the middle of its box is triangulated again.
//
//   g++ -std=c++17 -O2 example.cpp -o example && ./example rig.table
#include <cstdio>
#include <vector>

#include "implicam.hpp"

int main(int count, char** words) {
  implicam::Rig rig;
  const implicam::Status loaded = rig.load(count > 1 ? words[1] : "rig.table");
  if (loaded != implicam::Status::ok) {
    std::fprintf(stderr, "%s\n", implicam::message(loaded));
    return 1;
  }
  const char* unit = rig.length_unit().c_str();
  std::printf("%d cameras, calibration %.16s\n", rig.cameras(), rig.calibration_sha256().c_str());

  const auto low = rig.lowest(), high = rig.highest();
  std::vector<implicam::View> views(static_cast<std::size_t>(rig.cameras()));  // of a camera that is not set: not seen
  for (int c = 0; c < rig.cameras(); ++c) {
    const implicam::Pixel seen = rig.project(c, (low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2);
    if (seen.status != implicam::Status::ok) continue;
    views[static_cast<std::size_t>(c)] = {seen.uv[0], seen.uv[1]};
    std::printf("  %s sees it at %.3f, %.3f px\n", rig.camera(c).name.c_str(), seen.uv[0], seen.uv[1]);
  }
  const implicam::Position found = rig.triangulate(views);
  if (!found.measured()) {
    std::fprintf(stderr, "%s\n", implicam::message(found.status));
    return 1;
  }
  for (std::size_t a = 0; a < 3; ++a)
    std::printf("  %c = %.4f +- %.4f %s\n", "xyz"[a], found.xyz[a], std::sqrt(found.covariance[a][a]), unit);
  std::printf("  the views agree: p = %.3f\n", found.p);
  return 0;
}
