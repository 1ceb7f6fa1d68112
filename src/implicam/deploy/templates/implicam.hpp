// implicam.hpp: measure with an implicam calibration in C++17, without any other library.
//
// `implicam export rig.implicam --to cpp -o folder` writes this file and a table, rig.table.
//
//   implicam::Rig rig;
//   implicam::Status status = rig.load("rig.table");
//   if (status != implicam::Status::ok) { puts(implicam::message(status)); return 1; }
//   std::vector<implicam::View> views(rig.cameras());                    // not seen unless it is set
//   views[0] = {612.3, 401.8}; views[2] = {330.1, 418.6};
//   implicam::Position found = rig.triangulate(views);
//   if (found.measured()) printf("%g %g %g\n", found.xyz[0], found.xyz[1], found.xyz[2]);
//
// Positions are in the world of the known positions and in its length unit; pixels are (column, row), (0, 0) the centre
// of the top-left pixel. A `Rig` does not change once it is loaded: any number of threads may use one. Nothing throws:
// what cannot be done is a Status. Equation numbers: docs/method.md of implicam.
//
// SPDX-License-Identifier: Apache-2.0
#ifndef IMPLICAM_HPP
#define IMPLICAM_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <limits>
#include <new>
#include <string>
#include <utility>
#include <vector>

namespace implicam {

enum class Status {
  ok,
  doubtful,            // measured, but the views hardly agree, and none of them is clearly the wrong one
  not_seen,            // no camera saw it
  too_few_views,       // one camera saw it; a position takes two
  views_contradict,    // no position explains the views: a wrong match in one of them
  no_position,         // lines of sight nearly coincide, or lead nowhere
  outside_workspace,   // it, or where its views meet best, lies outside of the box of the table
  not_tabulated,       // a place where the table is not accurate enough for one of these cameras
  outside_image,       // the camera does not see this position
  wrong_input,         // a camera that is not there, a number that is none, not one view for each camera
  not_loaded,          // load a table first
  cannot_read,         // the file is not there, or cannot be read
  not_a_table,         // the file is something else
  wrong_version,       // the table is of another version of implicam: export it again, and take its implicam.hpp
  damaged,             // the file is cut off or changed: copy it again
  out_of_memory,
  unsupported_machine  // big-endian processors
};

inline const char* message(Status status) {
  switch (status) {
    case Status::ok: return "ok";
    case Status::doubtful: return "measured, but the views hardly agree, and none of them is clearly the wrong one";
    case Status::not_seen: return "no camera saw it";
    case Status::too_few_views: return "one camera saw it; a position takes two";
    case Status::views_contradict: return "the views contradict each other: a wrong match in one of them";
    case Status::no_position: return "no position explains the views";
    case Status::outside_workspace: return "it, or where its views meet best, lies outside of the box of the table";
    case Status::not_tabulated: return "the table is not accurate enough there for one of these cameras";
    case Status::outside_image: return "the camera does not see this position";
    case Status::wrong_input: return "a camera that is not there, a number that is none, or not one view a camera";
    case Status::not_loaded: return "no table is loaded";
    case Status::cannot_read: return "the file is not there, or cannot be read";
    case Status::not_a_table: return "the file is no table of implicam";
    case Status::wrong_version: return "the table is of another version: export it again, and take its implicam.hpp";
    case Status::damaged: return "the file is cut off or changed: copy or export it again";
    case Status::out_of_memory: return "there is not enough memory";
    case Status::unsupported_machine: return "the processor is big-endian, for which this is not made";
  }
  return "unknown";
}

constexpr std::uint32_t TABLE_VERSION = 1;
constexpr double NOT_A_NUMBER = std::numeric_limits<double>::quiet_NaN();

// What one camera sees of a point, in pixels; not seen while u or v is NaN. sd: the standard uncertainty of u and of v;
// the camera's usual one where it is not a positive number.
struct View {
  double u = NOT_A_NUMBER, v = NOT_A_NUMBER, sd = NOT_A_NUMBER;
};

template <std::size_t N>
constexpr std::array<std::array<double, N>, N> nothing() {
  std::array<std::array<double, N>, N> out{};
  for (std::size_t i = 0; i < N; ++i)
    for (std::size_t j = 0; j < N; ++j) out[i][j] = NOT_A_NUMBER;
  return out;
}

struct Position {
  Status status = Status::not_loaded;
  std::array<double, 3> xyz{NOT_A_NUMBER, NOT_A_NUMBER, NOT_A_NUMBER};
  std::array<std::array<double, 3>, 3> covariance{nothing<3>()};  // of xyz, everything included
  double chi_squared = NOT_A_NUMBER;  // with 2 * views - 3 degrees of freedom where the views agree
  double p = NOT_A_NUMBER;            // the probability of a larger one
  int views = 0;                      // that were used
  std::vector<int> left_out;          // cameras whose view contradicts the others, and was not used
  bool measured() const { return status == Status::ok || status == Status::doubtful; }
};

struct Pixel {
  Status status = Status::not_loaded;
  std::array<double, 2> uv{NOT_A_NUMBER, NOT_A_NUMBER};
  std::array<std::array<double, 2>, 2> covariance{nothing<2>()};  // of a view there, with the camera's usual noise
};

// How far the table is from the calibration, at `places` random places and the corners of the box, when it was written:
// the largest error of a pixel over the sd of a view, the largest error of a variance over that of a view, and the part
// of the table (over places and cameras) that is marked as not accurate enough.
struct Accuracy {
  double pixel = NOT_A_NUMBER, variance = NOT_A_NUMBER, not_tabulated = NOT_A_NUMBER, places = 0;
};

struct Camera {
  std::string name;
  int width = 0, height = 0;  // of its images, 0 where not known
  double noise = 0;           // usual, of a view, in pixels
};

class Rig {
 public:
  Status load(const char* path) noexcept {
    try {
      std::vector<unsigned char> bytes;
      std::FILE* file = std::fopen(path, "rb");
      if (file == nullptr) return Status::cannot_read;
      std::array<unsigned char, 65536> block{};
      std::size_t got = 0;
      while ((got = std::fread(block.data(), 1, block.size(), file)) > 0) {
        if (bytes.size() > MAX_BYTES) break;
        bytes.insert(bytes.end(), block.begin(), block.begin() + static_cast<std::ptrdiff_t>(got));
      }
      const bool failed = std::ferror(file) != 0;
      std::fclose(file);
      return failed ? Status::cannot_read : load(bytes.data(), bytes.size());
    } catch (const std::bad_alloc&) {
      return Status::out_of_memory;
    }
  }
  Status load(const std::string& path) noexcept { return load(path.c_str()); }

  // The same from memory. What was loaded before stays where this fails.
  Status load(const void* data, std::size_t size) noexcept {
    try {
      Rig fresh;
      const Status status = fresh.parse(static_cast<const unsigned char*>(data), size);
      if (status == Status::ok) *this = std::move(fresh);
      return status;
    } catch (const std::bad_alloc&) {
      return Status::out_of_memory;
    } catch (...) {
      return Status::damaged;
    }
  }

  int cameras() const { return static_cast<int>(cameras_.size()); }
  const Camera& camera(int number) const { return cameras_.at(static_cast<std::size_t>(number)); }
  // The number of a camera; -1 where there is none of this name.
  int number_of(const std::string& name) const {
    for (int c = 0; c < cameras(); ++c)
      if (cameras_[static_cast<std::size_t>(c)].name == name) return c;
    return -1;
  }
  const std::string& length_unit() const { return unit_; }
  const std::string& implicam_version() const { return version_; }
  const std::string& calibration_sha256() const { return sha256_; }
  const Accuracy& accuracy() const { return accuracy_; }
  // The box that the table holds, in the world.
  std::array<double, 3> lowest() const { return corner(false); }
  std::array<double, 3> highest() const { return corner(true); }

  // Where a camera sees a position, eq. (19).
  Pixel project(int number, double x, double y, double z) const noexcept {
    Pixel out;
    if (cameras_.empty()) return out;
    out.status = Status::wrong_input;
    if (number < 0 || number >= cameras() || !std::isfinite(x) || !std::isfinite(y) || !std::isfinite(z)) return out;
    const std::size_t c = static_cast<std::size_t>(number);
    const Vec3 at = working({x, y, z});
    Cell cell;
    out.status = Status::outside_workspace;
    if (!locate(at, cell)) return out;
    out.status = Status::not_tabulated;
    if (marked(cell, c)) return out;
    Seen here = look(cell, at, c);
    if (estimated_) {  // the label of a known position there would be off
      const Vec3 off = label_error(at);
      const Vec3 there{at[0] + off[0], at[1] + off[1], at[2] + off[2]};
      out.status = Status::outside_workspace;
      if (!locate(there, cell)) return out;
      out.status = Status::not_tabulated;
      if (marked(cell, c)) return out;
      const Seen moved = look(cell, there, c);
      here.mean = moved.mean;
    }
    out.status = Status::outside_image;
    const double half = sensors_[c].half * VISIBLE_HALVES;
    const double du = here.mean[0] - sensors_[c].cu, dv = here.mean[1] - sensors_[c].cv;
    if (!(std::fabs(du) <= half && std::fabs(dv) <= half)) return out;
    const double noise = cameras_[c].noise * cameras_[c].noise;
    out.status = Status::ok;
    out.uv = {here.mean[0], here.mean[1]};
    out.covariance = {{{here.variance[0] + noise, here.variance[1]}, {here.variance[1], here.variance[2] + noise}}};
    return out;
  }

  // Where a point is, eqs. (20) to (22). views: one for each camera, in their order.
  Position triangulate(const std::vector<View>& views) const noexcept {
    return triangulate(views.data(), views.size());
  }
  Position triangulate(const View* views, std::size_t count) const noexcept {
    try {
      return measure(views, count);
    } catch (...) {
      Position out;
      out.status = Status::out_of_memory;
      return out;
    }
  }

 private:
  using Vec3 = std::array<double, 3>;
  using Mat3 = std::array<Vec3, 3>;
  static constexpr std::size_t MAX_BYTES = std::size_t{1} << 31, MAX_CAMERAS = 1000, MAX_NODES = 4096, CHANNELS = 8;
  static constexpr std::size_t HEADER = 64, ENTRY = 88, MAX_SECTIONS = 64, MAX_RANK = 6;
  static constexpr std::size_t MAX_VIEWS_FOR_PAIRS = 12;
  static constexpr int MAX_STEPS = 60, STEPS_TO_MEND = 3;
  static constexpr double STEP_SDS = 1e-7, VISIBLE_HALVES = 1.5, FARTHEST = 1.0, HOPELESS_CHI_SQUARED = 1e4;

  struct Sensor {
    double cu = 0, cv = 0, half = 0, stated = 0;
  };
  struct Shot {
    Vec3 centre{}, extent{};
    Mat3 axes{};
    double radius = 1, along = 0;  // along: place on the traverse, in half its length
    std::vector<double> pattern;
  };
  struct Cell {
    Vec3 beyond{};  // how far a place is outside of the box; the table goes on in straight lines
    std::array<std::size_t, 3> index{};
    std::array<std::array<double, 4>, 3> weight{}, slope{};
  };
  struct Seen {
    std::array<double, 2> mean{};
    std::array<Vec3, 2> by_point{};
    std::array<double, 3> variance{};  // uu, uv, vv, without the noise of a view
  };
  struct Section {
    std::string name;
    std::uint32_t type = 0;
    std::vector<std::size_t> shape;
    const unsigned char* data = nullptr;
    std::size_t size = 0;
  };

  // What is loaded.
  std::vector<Camera> cameras_;
  std::vector<Sensor> sensors_;
  std::vector<std::array<double, 12>> projection_;
  std::string unit_, version_, sha256_;
  Accuracy accuracy_;
  Vec3 offset_{}, low_{}, step_{};
  double scale_ = 1;
  std::array<std::size_t, 3> nodes_{};
  std::vector<float> grid_, ties_, through_;
  std::vector<unsigned char> marks_;
  std::size_t mark_bytes_ = 0, unknowns_ = 0;
  double min_p_ = 0, disagree_p_ = 0, agree_p_ = 0, clearly_better_ = 0;
  bool misfit_adds_ = false, estimated_ = false;
  std::vector<Shot> shots_;
  Mat3 along_{};
  Vec3 middle_{};
  double reach_ = 0, half_length_ = 1, farthest_ = 0, most_ratio_ = 0, tilt_radii_ = 0;
  std::array<double, 6> bars_{};
  std::vector<double> label_sd_, label_mean_, label_covariance_, polynomial_;  // polynomial_: (terms, shots)

  // ---- reading -----------------------------------------------------------------------------------------------------

  template <class T>
  static T number(const unsigned char* at) {
    T value;
    std::memcpy(&value, at, sizeof(T));
    return value;
  }

  static bool little_endian() {
    const std::uint32_t one = 1;
    unsigned char first = 0;
    std::memcpy(&first, &one, 1);
    return first == 1;
  }

  // CRC-32, as of zip files.
  static std::uint32_t digest(const unsigned char* data, std::size_t size) {
    std::array<std::uint32_t, 256> table{};
    for (std::uint32_t i = 0; i < 256; ++i) {
      std::uint32_t value = i;
      for (int bit = 0; bit < 8; ++bit) value = (value & 1U) != 0 ? 0xEDB88320U ^ (value >> 1) : value >> 1;
      table[i] = value;
    }
    std::uint32_t crc = 0xFFFFFFFFU;
    for (std::size_t i = 0; i < size; ++i) crc = table[(crc ^ data[i]) & 0xFFU] ^ (crc >> 8);
    return crc ^ 0xFFFFFFFFU;
  }

  Status parse(const unsigned char* data, std::size_t size) {
    if (!little_endian()) return Status::unsupported_machine;
    if (data == nullptr || size < 8 || std::memcmp(data, "IMPLITBL", 8) != 0) return Status::not_a_table;
    if (size < 12) return Status::damaged;
    if (number<std::uint32_t>(data + 8) != TABLE_VERSION) return Status::wrong_version;
    if (size < HEADER || number<std::uint64_t>(data + 16) != size) return Status::damaged;
    if (number<std::uint64_t>(data + 24) != digest(data + 32, size - 32)) return Status::damaged;
    const std::size_t count = number<std::uint32_t>(data + 12);
    if (count > MAX_SECTIONS || size < HEADER + count * ENTRY) return Status::damaged;
    static const char* const digits = "0123456789abcdef";
    for (std::size_t i = 32; i < 64; ++i) {
      sha256_ += digits[data[i] >> 4];
      sha256_ += digits[data[i] & 15];
    }
    std::vector<Section> sections;
    for (std::size_t i = 0; i < count; ++i) {
      const unsigned char* entry = data + HEADER + i * ENTRY;
      Section section;
      section.name.assign(reinterpret_cast<const char*>(entry), 16);
      section.name.resize(std::strlen(section.name.c_str()));
      section.type = number<std::uint32_t>(entry + 16);
      const std::size_t rank = number<std::uint32_t>(entry + 20);
      static constexpr std::array<std::size_t, 4> ITEM{0, 8, 4, 1};  // float64, float32, bytes
      if (rank > MAX_RANK || section.type < 1 || section.type > 3) return Status::damaged;
      std::size_t expected = ITEM[section.type];
      for (std::size_t k = 0; k < rank; ++k) {
        const std::uint64_t side = number<std::uint64_t>(entry + 24 + 8 * k);
        if (side != 0 && expected > size / side) return Status::damaged;
        expected *= static_cast<std::size_t>(side);
        section.shape.push_back(static_cast<std::size_t>(side));
      }
      const std::uint64_t start = number<std::uint64_t>(entry + 72), length = number<std::uint64_t>(entry + 80);
      if (length != expected || start > size || length > size - start) return Status::damaged;
      section.data = data + start;
      section.size = static_cast<std::size_t>(length);
      sections.push_back(section);
    }
    return build(sections) ? Status::ok : Status::damaged;
  }

  static const Section* find(const std::vector<Section>& sections, const char* name) {
    for (const Section& section : sections)
      if (section.name == name) return &section;
    return nullptr;
  }

  // The numbers of a section, which must have this shape, and be finite unless `holes`.
  static bool read(const std::vector<Section>& sections, const char* name, const std::vector<std::size_t>& shape,
                   std::vector<double>& out, bool holes = false) {
    const Section* section = find(sections, name);
    if (section == nullptr || section->type != 1 || section->shape != shape) return false;
    out.resize(section->size / 8);
    if (!out.empty()) std::memcpy(out.data(), section->data, section->size);
    return holes || std::all_of(out.begin(), out.end(), [](double x) { return std::isfinite(x); });
  }

  static bool read(const std::vector<Section>& sections, const char* name, const std::vector<std::size_t>& shape,
                   std::vector<float>& out) {
    const Section* section = find(sections, name);
    if (section == nullptr || section->type != 2 || section->shape != shape) return false;
    out.resize(section->size / 4);
    if (!out.empty()) std::memcpy(out.data(), section->data, section->size);
    return std::all_of(out.begin(), out.end(), [](float x) { return std::isfinite(x); });
  }

  static std::string text(const Section& section) {
    return std::string(reinterpret_cast<const char*>(section.data), section.size);
  }

  bool build(const std::vector<Section>& sections) {
    const Section *names = find(sections, "names"), *about = find(sections, "about"), *grid = find(sections, "grid");
    if (names == nullptr || about == nullptr || grid == nullptr || names->type != 3 || about->type != 3) return false;
    if (grid->shape.size() != 5 || grid->shape[4] != CHANNELS) return false;
    const std::size_t C = grid->shape[3];
    if (C < 1 || C > MAX_CAMERAS) return false;
    for (std::size_t a = 0; a < 3; ++a) {
      nodes_[a] = grid->shape[a];
      if (nodes_[a] < 4 || nodes_[a] > MAX_NODES) return false;
    }
    const std::vector<std::size_t> box{nodes_[0], nodes_[1], nodes_[2]};
    if (!read(sections, "grid", {box[0], box[1], box[2], C, CHANNELS}, grid_)) return false;
    const Section* marks = find(sections, "marks");
    mark_bytes_ = (C + 7) / 8;
    const std::vector<std::size_t> cells{box[0] - 3, box[1] - 3, box[2] - 3, mark_bytes_};
    if (marks == nullptr || marks->type != 3 || marks->shape != cells) return false;
    marks_.assign(marks->data, marks->data + marks->size);
    const std::string lines = text(*about);
    const std::size_t line = lines.find('\n');
    if (line == std::string::npos) return false;
    unit_ = lines.substr(0, line);
    version_ = lines.substr(line + 1);

    std::vector<double> values;
    if (!read(sections, "frame", {10}, values)) return false;
    for (std::size_t a = 0; a < 3; ++a) {
      offset_[a] = values[a];
      low_[a] = values[4 + a];
      step_[a] = values[7 + a];
      if (!(step_[a] > 0)) return false;
    }
    scale_ = values[3];
    if (!(scale_ > 0)) return false;
    if (!read(sections, "rules", {9}, values)) return false;
    min_p_ = values[0];
    disagree_p_ = values[1];
    agree_p_ = values[2];
    clearly_better_ = values[3];
    misfit_adds_ = values[4] > 0;
    accuracy_ = {values[5], values[6], values[7], values[8]};
    if (!read(sections, "sensors", {C, 7}, values, true)) return false;
    std::string rest = text(*names);
    for (std::size_t c = 0; c < C; ++c) {
      const double* row = values.data() + 7 * c;
      for (int k = 0; k < 6; ++k)
        if (!std::isfinite(row[k])) return false;
      if (!(row[2] > 0) || !(row[5] > 0) || row[0] < 0 || row[1] < 0 || row[0] > 1e9 || row[1] > 1e9) return false;
      const std::size_t end = rest.find('\n');
      if (end == std::string::npos) return false;
      cameras_.push_back({rest.substr(0, end), static_cast<int>(row[0]), static_cast<int>(row[1]), row[2]});
      rest = rest.substr(end + 1);
      sensors_.push_back({row[3], row[4], row[5], row[6]});
    }
    if (!read(sections, "projections", {C, 12}, values)) return false;
    projection_.resize(C);
    for (std::size_t c = 0; c < C; ++c) std::copy_n(values.data() + 12 * c, 12, projection_[c].begin());
    if (find(sections, "ties") != nullptr &&
        !read(sections, "ties", {box[0], box[1], box[2], C * (C - 1) / 2, 4}, ties_))
      return false;
    return find(sections, "shots") == nullptr || build_labels(sections, box, C);
  }

  bool build_labels(const std::vector<Section>& sections, const std::vector<std::size_t>& box, std::size_t C) {
    const Section* shots = find(sections, "shots");
    if (shots->shape.size() != 2 || shots->shape[1] != 17) return false;
    if (shots->shape[0] < 1 || shots->shape[0] > 100000) return false;
    const std::size_t S = shots->shape[0];
    std::vector<double> values;
    if (!read(sections, "shots", {S, 17}, values)) return false;
    for (std::size_t s = 0; s < S; ++s) {
      const double* row = values.data() + 17 * s;
      Shot shot;
      for (std::size_t a = 0; a < 3; ++a) {
        shot.centre[a] = row[a];
        shot.extent[a] = row[12 + a];
        for (std::size_t b = 0; b < 3; ++b) shot.axes[a][b] = row[3 + 3 * a + b];
      }
      shot.radius = row[15];
      shot.along = row[16];
      if (!(shot.radius > 0)) return false;
      shots_.push_back(shot);
    }
    if (!read(sections, "world", {23}, values)) return false;
    for (std::size_t a = 0; a < 3; ++a) {
      for (std::size_t b = 0; b < 3; ++b) along_[a][b] = values[3 * a + b];
      middle_[a] = values[9 + a];
    }
    reach_ = values[12];
    half_length_ = values[13];
    farthest_ = values[14];
    most_ratio_ = values[15];
    tilt_radii_ = values[16];
    std::copy_n(values.begin() + 17, 6, bars_.begin());
    if (!(half_length_ > 0) || !(reach_ >= 0)) return false;
    const Section* polynomial = find(sections, "polynomial");
    if (polynomial == nullptr || polynomial->shape.size() != 2) return false;
    if (polynomial->shape[0] < 1 || polynomial->shape[0] > 3) return false;
    if (!read(sections, "polynomial", {polynomial->shape[0], S}, polynomial_)) return false;
    const Section* sd = find(sections, "label_sd");
    if (sd == nullptr) return true;
    if (S <= 3 || sd->shape.size() != 1 || sd->shape[0] != 6 * (S - 3)) return false;
    unknowns_ = sd->shape[0];
    estimated_ = true;
    if (!read(sections, "label_sd", {unknowns_}, label_sd_) || !read(sections, "label_mean", {unknowns_}, label_mean_) ||
        !read(sections, "label_covariance", {unknowns_, unknowns_}, label_covariance_) ||
        !read(sections, "pattern", {S, S - 3}, values) ||
        !read(sections, "through", {box[0], box[1], box[2], C, 2, unknowns_}, through_))
      return false;
    for (std::size_t s = 0; s < S; ++s)
      shots_[s].pattern.assign(values.begin() + static_cast<std::ptrdiff_t>(s * (S - 3)),
                               values.begin() + static_cast<std::ptrdiff_t>((s + 1) * (S - 3)));
    return true;
  }

  // ---- the table ---------------------------------------------------------------------------------------------------

  Vec3 working(const Vec3& world) const {
    return {(world[0] - offset_[0]) / scale_, (world[1] - offset_[1]) / scale_, (world[2] - offset_[2]) / scale_};
  }

  std::array<double, 3> corner(bool high) const {
    std::array<double, 3> out{};
    for (std::size_t a = 0; a < 3; ++a) {
      const double cells = high && nodes_[a] > 3 ? static_cast<double>(nodes_[a] - 3) : 0.0;
      out[a] = (low_[a] + cells * step_[a]) * scale_ + offset_[a];
    }
    return out;
  }

  // The cell of a place of the working frame, and the weights of its nodes: uniform cubic B-splines. False where it is
  // outside of the box; then the cell is the nearest.
  bool locate(const Vec3& at, Cell& cell) const {
    bool held = true;
    for (std::size_t a = 0; a < 3; ++a) {
      const double t = (at[a] - low_[a]) / step_[a], cells = static_cast<double>(nodes_[a] - 3);
      held = held && t >= -1e-9 && t <= cells + 1e-9;
      const double inside = t > 0 ? std::min(t, cells) : 0.0;  // also of a NaN
      cell.beyond[a] = (t - inside) * step_[a];
      const std::size_t i = std::min(static_cast<std::size_t>(inside), nodes_[a] - 4);
      const double f = inside - static_cast<double>(i), g = 1 - f;
      cell.index[a] = i;
      cell.weight[a] = {g * g * g / 6, (3 * f * f * f - 6 * f * f + 4) / 6, (-3 * f * f * f + 3 * f * f + 3 * f + 1) / 6,
                        f * f * f / 6};
      cell.slope[a] = {-g * g / 2, (3 * f * f - 4 * f) / 2, (-3 * f * f + 2 * f + 1) / 2, f * f / 2};
      for (double& s : cell.slope[a]) s /= step_[a];
    }
    return held;
  }

  bool marked(const Cell& cell, std::size_t c) const {
    const std::size_t at = (cell.index[0] * (nodes_[1] - 3) + cell.index[1]) * (nodes_[2] - 3) + cell.index[2];
    return (marks_[at * mark_bytes_ + c / 8] >> (c % 8) & 1) != 0;
  }

  // Calls f(node number, weight, slope of the weight by the place) for the 64 nodes of a cell.
  template <class F>
  void over_nodes(const Cell& cell, F f) const {
    for (std::size_t i = 0; i < 4; ++i)
      for (std::size_t j = 0; j < 4; ++j) {
        const double xy = cell.weight[0][i] * cell.weight[1][j], dx = cell.slope[0][i] * cell.weight[1][j],
                     dy = cell.weight[0][i] * cell.slope[1][j];
        const std::size_t row = ((cell.index[0] + i) * nodes_[1] + cell.index[1] + j) * nodes_[2] + cell.index[2];
        for (std::size_t k = 0; k < 4; ++k) {
          const double z = cell.weight[2][k];
          f(row + k, xy * z, Vec3{dx * z, dy * z, xy * cell.slope[2][k]});
        }
      }
  }

  Seen look(const Cell& cell, const Vec3& at, std::size_t c) const {
    Seen out;
    const std::size_t C = cameras_.size();
    over_nodes(cell, [&](std::size_t node, double w, const Vec3& by) {
      const float* values = grid_.data() + (node * C + c) * CHANNELS;
      for (std::size_t i = 0; i < 2; ++i) {
        const double value = static_cast<double>(values[i]);
        out.mean[i] += w * value;
        for (std::size_t a = 0; a < 3; ++a) out.by_point[i][a] += by[a] * value;
      }
      for (std::size_t i = 0; i < 3; ++i) out.variance[i] += w * static_cast<double>(values[2 + i]);
    });
    for (std::size_t i = 0; i < 2; ++i) out.mean[i] += dot(out.by_point[i], cell.beyond);
    const std::array<double, 12>& P = projection_[c];
    const double w = P[8] * at[0] + P[9] * at[1] + P[10] * at[2] + P[11];
    for (std::size_t i = 0; i < 2; ++i) {
      const double* row = P.data() + 4 * i;
      const double pixel = (row[0] * at[0] + row[1] * at[1] + row[2] * at[2] + row[3]) / w;
      out.mean[i] += pixel;
      for (std::size_t a = 0; a < 3; ++a) out.by_point[i][a] += (row[a] - pixel * P[8 + a]) / w;
    }
    return out;
  }

  // The covariance of u, v of one camera with u, v of a later one: uu, uv, vu, vv.
  std::array<double, 4> tie(const Cell& cell, std::size_t c, std::size_t d) const {
    const std::size_t C = cameras_.size(), pairs = C * (C - 1) / 2, pair = c * (2 * C - c - 1) / 2 + d - c - 1;
    std::array<double, 4> out{};
    over_nodes(cell, [&](std::size_t node, double w, const Vec3&) {
      const float* values = ties_.data() + (node * pairs + pair) * 4;
      for (std::size_t i = 0; i < 4; ++i) out[i] += w * static_cast<double>(values[i]);
    });
    return out;
  }

  // ---- measuring ---------------------------------------------------------------------------------------------------

  // Cholesky factor of a symmetric matrix (n, n) in place, lower triangle; false where it is not positive definite.
  static bool factor(std::vector<double>& A, std::size_t n) {
    for (std::size_t j = 0; j < n; ++j) {
      for (std::size_t i = j; i < n; ++i) {
        double sum = A[i * n + j];
        for (std::size_t k = 0; k < j; ++k) sum -= A[i * n + k] * A[j * n + k];
        if (i == j) {
          if (!(sum > 0)) return false;
          A[i * n + i] = std::sqrt(sum);
        } else {
          A[i * n + j] = sum / A[j * n + j];
        }
      }
    }
    return true;
  }

  // L^-1 b in place, b (n, columns).
  static void forward(const std::vector<double>& L, std::size_t n, std::vector<double>& b, std::size_t columns) {
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t q = 0; q < columns; ++q) {
        double sum = b[i * columns + q];
        for (std::size_t k = 0; k < i; ++k) sum -= L[i * n + k] * b[k * columns + q];
        b[i * columns + q] = sum / L[i * n + i];
      }
  }

  static bool invert(const Mat3& A, Mat3& out) {
    const double a = A[1][1] * A[2][2] - A[1][2] * A[2][1], b = A[0][2] * A[2][1] - A[0][1] * A[2][2],
                 c = A[0][1] * A[1][2] - A[0][2] * A[1][1];
    const double det = A[0][0] * a + A[1][0] * b + A[2][0] * c;
    if (!(std::fabs(det) > 0) || !std::isfinite(det)) return false;
    out = {{{a / det, b / det, c / det},
            {(A[1][2] * A[2][0] - A[1][0] * A[2][2]) / det, (A[0][0] * A[2][2] - A[0][2] * A[2][0]) / det,
             (A[0][2] * A[1][0] - A[0][0] * A[1][2]) / det},
            {(A[1][0] * A[2][1] - A[1][1] * A[2][0]) / det, (A[0][1] * A[2][0] - A[0][0] * A[2][1]) / det,
             (A[0][0] * A[1][1] - A[0][1] * A[1][0]) / det}}};
    for (std::size_t i = 0; i < 3; ++i)
      if (!(out[i][i] > 0)) return false;
    return true;
  }

  static Vec3 times(const Mat3& A, const Vec3& x) {
    Vec3 out{};
    for (std::size_t i = 0; i < 3; ++i)
      for (std::size_t j = 0; j < 3; ++j) out[i] += A[i][j] * x[j];
    return out;
  }

  static double dot(const Vec3& a, const Vec3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  static Vec3 cross(const Vec3& a, const Vec3& b) {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
  }

  // The views of one point, and the normal equations at a place: H, g, and the weighted squares, eq. (20).
  struct Views {
    std::vector<std::size_t> cameras;
    std::vector<double> uv, noise;
  };
  struct Normal {
    Mat3 H{};
    Vec3 g{};
    double squares = 0;
    bool held = false;  // in the box
    Cell cell;
    std::vector<double> L, D, r, residuals;  // factor of S, L^-1 D (2 V, 3), L^-1 r, and r
  };

  bool normal(const Views& views, const Vec3& at, Normal& out) const {
    const std::size_t V = views.cameras.size(), n = 2 * V;
    out.held = locate(at, out.cell);
    out.L.assign(n * n, 0.0);
    out.D.assign(n * 3, 0.0);
    out.r.assign(n, 0.0);
    for (std::size_t i = 0; i < V; ++i) {
      const std::size_t c = views.cameras[i];
      const Seen seen = look(out.cell, at, c);
      const double noise = views.noise[i] * views.noise[i];
      out.L[(2 * i) * n + 2 * i] = seen.variance[0] + noise;
      out.L[(2 * i + 1) * n + 2 * i] = seen.variance[1];
      out.L[(2 * i + 1) * n + 2 * i + 1] = seen.variance[2] + noise;
      for (std::size_t k = 0; k < 2; ++k) {
        out.r[2 * i + k] = views.uv[2 * i + k] - seen.mean[k];
        for (std::size_t a = 0; a < 3; ++a) out.D[(2 * i + k) * 3 + a] = seen.by_point[k][a];
      }
      if (!ties_.empty())
        for (std::size_t j = 0; j < i; ++j) {
          const std::array<double, 4> between = tie(out.cell, views.cameras[j], c);
          for (std::size_t k = 0; k < 2; ++k)
            for (std::size_t l = 0; l < 2; ++l) out.L[(2 * i + k) * n + 2 * j + l] = between[2 * l + k];
        }
    }
    if (!factor(out.L, n)) return false;
    out.residuals = out.r;
    forward(out.L, n, out.D, 3);
    forward(out.L, n, out.r, 1);
    out.H = {};
    out.g = {};
    out.squares = 0;
    for (std::size_t i = 0; i < n; ++i) {
      out.squares += out.r[i] * out.r[i];
      for (std::size_t a = 0; a < 3; ++a) {
        out.g[a] += out.D[3 * i + a] * out.r[i];
        for (std::size_t b = 0; b < 3; ++b) out.H[a][b] += out.D[3 * i + a] * out.D[3 * i + b];
      }
    }
    return std::isfinite(out.squares);
  }

  // The part of a squared distance with an odd number of degrees of freedom that is larger by chance.
  static double survival(double x, int degrees) {
    if (!(x > 0)) return 1.0;
    double sum = 0, term = std::sqrt(2 * x / 3.14159265358979323846) * std::exp(-x / 2);
    for (int i = 1; i < degrees; i += 2) {
      sum += term;
      term *= x / (i + 2);
    }
    return std::min(1.0, std::erfc(std::sqrt(x / 2)) + sum);
  }

  // The nearest place that is not farther outside of the box than it is wide, times `beyond`.
  Vec3 inside(Vec3 at, double beyond) const {
    for (std::size_t a = 0; a < 3; ++a) {
      const double side = step_[a] * static_cast<double>(nodes_[a] - 3), low = low_[a] - beyond * side;
      at[a] = std::min(std::max(at[a], low), low_[a] + (1 + beyond) * side);
    }
    return at;
  }

  // The place that the linear projections say; the middle of the box where they say none.
  Vec3 start(const Views& views) const {
    Mat3 A{}, inverse{};
    Vec3 b{};
    for (std::size_t i = 0; i < views.cameras.size(); ++i) {
      const std::array<double, 12>& P = projection_[views.cameras[i]];
      for (std::size_t k = 0; k < 2; ++k) {
        Vec3 row{};
        for (std::size_t a = 0; a < 3; ++a) row[a] = views.uv[2 * i + k] * P[8 + a] - P[4 * k + a];
        const double right = P[4 * k + 3] - views.uv[2 * i + k] * P[11];
        for (std::size_t a = 0; a < 3; ++a) {
          b[a] += row[a] * right;
          for (std::size_t c = 0; c < 3; ++c) A[a][c] += row[a] * row[c];
        }
      }
    }
    Vec3 at{};
    if (invert(A, inverse)) at = times(inverse, b);
    if (!std::isfinite(at[0]) || !std::isfinite(at[1]) || !std::isfinite(at[2])) at = {};
    return inside(at, 0.0);
  }

  // Gauss-Newton from a place, halving steps that make it worse. False where it does not end.
  bool descend(const Views& views, Vec3& at, Normal& here, Vec3& step) const {
    Mat3 inverse{};
    Normal next;
    if (!normal(views, at, here)) return false;
    for (int i = 0; i < MAX_STEPS; ++i) {
      if (!invert(here.H, inverse)) return false;
      step = times(inverse, here.g);
      if (!(dot(step, here.g) > STEP_SDS * STEP_SDS)) return true;
      if (i > STEPS_TO_MEND && here.held && here.squares - dot(step, here.g) > HOPELESS_CHI_SQUARED) return false;
      double part = 1;
      for (int halvings = 0;; ++halvings) {
        const Vec3 there = inside({at[0] + part * step[0], at[1] + part * step[1], at[2] + part * step[2]}, FARTHEST);
        if (halvings == 30) return !here.held || !(dot(step, here.g) > 1e-3 * 1e-3);
        if (normal(views, there, next) && squares_of(next, here) <= here.squares * (1 + 1e-9) + 1e-12) {
          at = there;
          std::swap(here, next);
          break;
        }
        part *= 0.5;
      }
    }
    return !here.held;
  }

  // The weighted squares at one place, with the covariance of the views at another.
  static double squares_of(const Normal& residuals, const Normal& weights) {
    std::vector<double> r = residuals.residuals;
    forward(weights.L, r.size(), r, 1);
    double sum = 0;
    for (const double x : r) sum += x * x;
    return sum;
  }

  double noise_of(std::size_t c, double sd) const {
    const double usual = cameras_[c].noise, stated = sensors_[c].stated;
    if (!(std::isfinite(sd) && sd > 0)) return usual;
    if (!std::isfinite(stated)) return sd;
    if (misfit_adds_ && usual > stated) return std::sqrt(sd * sd + usual * usual - stated * stated);
    return sd * usual / stated;
  }

  struct Solution {
    Status status = Status::no_position;
    Vec3 at{};
    Mat3 covariance{};
    Normal here;
    double chi_squared = NOT_A_NUMBER, p = NOT_A_NUMBER;
  };

  // Where a point is by all of these views, in the working frame; from other starts too, where the first leads nowhere.
  void solve(const Views& views, Solution& out, bool other_starts = true) const {
    const int degrees = 2 * static_cast<int>(views.cameras.size()) - 3;
    Vec3 step{};
    Normal& here = out.here;
    out.at = start(views);
    bool ended = descend(views, out.at, here, step);
    for (int eighth = 0; other_starts && eighth < 8 && !(ended && here.held); ++eighth) {
      Vec3 other{}, other_step{};
      for (std::size_t a = 0; a < 3; ++a)
        other[a] = low_[a] + step_[a] * static_cast<double>(nodes_[a] - 3) * ((eighth >> a & 1) != 0 ? 0.75 : 0.25);
      Normal there;
      if (!descend(views, other, there, other_step)) continue;
      if (ended && there.squares >= here.squares) continue;
      ended = true;
      out.at = other;
      step = other_step;
      std::swap(here, there);
    }
    out.status = Status::no_position;
    if (!ended && !here.L.empty() && survival(here.squares - dot(here.g, step), degrees) < min_p_)
      out.status = Status::views_contradict;
    if (!ended || !invert(here.H, out.covariance)) return;
    out.chi_squared = std::max(0.0, here.squares - dot(here.g, step));
    out.p = survival(out.chi_squared, degrees);  // also outside of the box: views that agree there are not wrong
    out.status = Status::outside_workspace;
    if (!here.held) return;
    out.status = out.p < min_p_ ? Status::views_contradict : out.p < disagree_p_ ? Status::doubtful : Status::ok;
    for (std::size_t a = 0; a < 3; ++a) out.at[a] += step[a];
  }

  static Views without(const Views& views, std::size_t a, std::size_t b) {
    Views out;
    for (std::size_t i = 0; i < views.cameras.size(); ++i) {
      if (i == a || i == b) continue;
      out.cameras.push_back(views.cameras[i]);
      out.uv.insert(out.uv.end(), {views.uv[2 * i], views.uv[2 * i + 1]});
      out.noise.push_back(views.noise[i]);
    }
    return out;
  }

  // Leaves out the one view, or the two of five and more, without which the others agree, if that is clear, eq. (W3).
  void leave_out_wrong(Views& views, Solution& found, std::vector<int>& left_out) const {
    const std::size_t V = views.cameras.size(), none = V;
    for (std::size_t size = 1; size <= (V >= 5 ? 2U : 1U); ++size) {
      if (size == 2 && V > MAX_VIEWS_FOR_PAIRS) return;
      Solution best, tried;
      double second = 0;
      std::size_t first_out = none, second_out = none;
      best.p = 0;
      for (std::size_t a = 0; a < V; ++a)
        for (std::size_t b = size == 1 ? none : a + 1; b < (size == 1 ? none + 1 : V); ++b) {
          tried = Solution{};
          solve(without(views, a, b), tried, false);
          const double p = std::isfinite(tried.p) ? tried.p : 0.0;
          if (p > best.p) {
            second = best.p;
            std::swap(best, tried);
            first_out = a;
            second_out = b;
          } else {
            second = std::max(second, p);
          }
        }
      if (!(best.p > agree_p_ && best.p > clearly_better_ * second)) continue;
      left_out.push_back(static_cast<int>(views.cameras[first_out]));
      if (second_out != none) left_out.push_back(static_cast<int>(views.cameras[second_out]));
      views = without(views, first_out, second_out);
      found = std::move(best);
      return;
    }
  }

  Position measure(const View* given, std::size_t count) const {
    Position out;
    if (cameras_.empty()) return out;
    out.status = Status::wrong_input;
    if (count != cameras_.size() || given == nullptr) return out;
    Views views;
    for (std::size_t c = 0; c < count; ++c)
      if (std::isfinite(given[c].u) && std::isfinite(given[c].v)) {
        views.cameras.push_back(c);
        views.uv.push_back(given[c].u);
        views.uv.push_back(given[c].v);
        views.noise.push_back(noise_of(c, given[c].sd));
      }
    out.views = static_cast<int>(views.cameras.size());
    out.status = out.views == 0 ? Status::not_seen : Status::too_few_views;
    if (out.views < 2) return out;
    Solution found;
    solve(views, found);
    if (out.views >= 3 && !(found.p >= disagree_p_)) leave_out_wrong(views, found, out.left_out);
    out.views = static_cast<int>(views.cameras.size());
    out.chi_squared = found.chi_squared;
    out.p = found.p;
    out.status = found.status;
    if (!out.measured()) return out;
    for (const std::size_t c : views.cameras)
      if (marked(found.here.cell, c)) {
        out.status = Status::not_tabulated;
        return out;
      }
    if (!shots_.empty()) as_labelled(views, found.here, found.at, found.covariance);
    for (std::size_t a = 0; a < 3; ++a) {
      out.xyz[a] = found.at[a] * scale_ + offset_[a];
      for (std::size_t b = 0; b < 3; ++b) out.covariance[a][b] = found.covariance[a][b] * scale_ * scale_;
    }
    return out;
  }

  // ---- the world as labelled, eqs. (16), (22) and (28) ---------------------------------------------------------------

  struct Label {
    std::size_t shot = 0;
    double holds = 0;
    std::array<Vec3, 6> moves{};  // displacement by a unit along, across (2), and by three tilts
  };

  Label nearest(const Vec3& at) const {
    Label out;
    double least = std::numeric_limits<double>::infinity();
    for (std::size_t s = 0; s < shots_.size(); ++s) {
      const Vec3 from{at[0] - shots_[s].centre[0], at[1] - shots_[s].centre[1], at[2] - shots_[s].centre[2]};
      double squares = 0;
      for (std::size_t a = 0; a < 3; ++a) {
        const double beyond = std::max(std::fabs(dot(shots_[s].axes[a], from)) - shots_[s].extent[a], 0.0);
        squares += beyond * beyond;
      }
      if (squares < least) {
        least = squares;
        out.shot = s;
      }
    }
    const Shot& shot = shots_[out.shot];
    out.holds = reach_ > 0 ? std::exp(-0.5 * least / (reach_ * reach_)) : 0.0;
    const Vec3 lever{(at[0] - shot.centre[0]) / shot.radius, (at[1] - shot.centre[1]) / shot.radius,
                     (at[2] - shot.centre[2]) / shot.radius};
    for (std::size_t a = 0; a < 3; ++a) {
      out.moves[a] = along_[a];
      Vec3 axis{};
      axis[a] = 1;
      out.moves[3 + a] = cross(axis, lever);
    }
    return out;
  }

  // How a label is off by each of the unknowns: (unknowns) of (3).
  std::vector<Vec3> label_slope(const Label& label) const {
    std::vector<Vec3> out(unknowns_);
    const std::vector<double>& pattern = shots_[label.shot].pattern;
    for (std::size_t a = 0; a < 6; ++a)
      for (std::size_t l = 0; l < pattern.size(); ++l) {
        const std::size_t k = a * pattern.size() + l;
        for (std::size_t i = 0; i < 3; ++i) out[k][i] = label.holds * label.moves[a][i] * pattern[l] * label_sd_[k];
      }
    return out;
  }

  Vec3 label_error(const Vec3& at) const {
    Vec3 out{};
    const Label label = nearest(at);
    const std::vector<double>& pattern = shots_[label.shot].pattern;
    for (std::size_t a = 0; a < 6; ++a)
      for (std::size_t l = 0; l < pattern.size(); ++l) {
        const std::size_t k = a * pattern.size() + l;
        const double size = label.holds * pattern[l] * label_sd_[k] * label_mean_[k];
        for (std::size_t i = 0; i < 3; ++i) out[i] += label.moves[a][i] * size;
      }
    return out;
  }

  // The variance of the world over that of a shot's error, eq. (28).
  double world_ratio(const Vec3& at) const {
    const Vec3 from{at[0] - middle_[0], at[1] - middle_[1], at[2] - middle_[2]};
    const double t = std::min(std::max(dot(along_[0], from) / half_length_, -farthest_), farthest_);
    const std::size_t S = shots_.size(), terms = polynomial_.size() / S;
    double ratio = 0;
    for (std::size_t s = 0; s < S; ++s) {
      double weight = 0;
      for (std::size_t k = 0; k < terms; ++k) weight = weight * t + polynomial_[k * S + s];
      ratio += weight * weight;
    }
    return std::min(ratio, most_ratio_);
  }

  void as_labelled(const Views& views, const Normal& here, Vec3& at, Mat3& covariance) const {
    const Label label = nearest(at);
    const Mat3 C = covariance;
    const double open = reach_ > 0 ? 1 - label.holds * label.holds : 0.0;
    if (open > 0) {
      const Vec3 from{at[0] - shots_[label.shot].centre[0], at[1] - shots_[label.shot].centre[1],
                      at[2] - shots_[label.shot].centre[2]};
      const double length = std::sqrt(dot(from, from)) / shots_[label.shot].radius;
      const double within = std::min(1.0, tilt_radii_ / std::max(length, 1e-12)), size = open * world_ratio(at);
      for (std::size_t a = 0; a < 6; ++a) {
        const double sd = bars_[a] * (a < 3 ? 1.0 : within);
        for (std::size_t i = 0; i < 3; ++i)
          for (std::size_t j = 0; j < 3; ++j) covariance[i][j] += size * sd * sd * label.moves[a][i] * label.moves[a][j];
      }
    }
    if (!estimated_) return;
    const std::size_t n = 2 * views.cameras.size(), K = unknowns_, all = cameras_.size();
    const std::vector<Vec3> W = label_slope(label);
    std::vector<double> F(n * K, 0.0);  // covariance of what the cameras would see with the unknowns
    over_nodes(here.cell, [&](std::size_t node, double w, const Vec3&) {
      for (std::size_t i = 0; i < views.cameras.size(); ++i) {
        const float* values = through_.data() + (node * all + views.cameras[i]) * 2 * K;
        for (std::size_t k = 0; k < 2 * K; ++k) F[2 * i * K + k] += w * static_cast<double>(values[k]);
      }
    });
    std::vector<double> FW(n * 3, 0.0);  // F W^T
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t k = 0; k < K; ++k)
        for (std::size_t a = 0; a < 3; ++a) FW[3 * i + a] += F[i * K + k] * W[k][a];
    forward(here.L, n, FW, 3);
    Mat3 DFW{};  // D^T S^-1 F W^T
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t a = 0; a < 3; ++a)
        for (std::size_t b = 0; b < 3; ++b) DFW[a][b] += here.D[3 * i + a] * FW[3 * i + b];
    Mat3 U{};
    for (std::size_t a = 0; a < 3; ++a)
      for (std::size_t b = 0; b < 3; ++b)
        for (std::size_t c = 0; c < 3; ++c) U[a][b] += C[a][c] * DFW[c][b];
    for (std::size_t k = 0; k < K; ++k) {
      Vec3 ZW{};  // cov(z) W^T
      for (std::size_t l = 0; l < K; ++l)
        for (std::size_t a = 0; a < 3; ++a) ZW[a] += label_covariance_[k * K + l] * W[l][a];
      for (std::size_t a = 0; a < 3; ++a) {
        at[a] -= W[k][a] * label_mean_[k];
        for (std::size_t b = 0; b < 3; ++b) covariance[a][b] += W[k][a] * ZW[b];
      }
    }
    for (std::size_t a = 0; a < 3; ++a)
      for (std::size_t b = 0; b < 3; ++b) covariance[a][b] += U[a][b] + U[b][a];
  }
};

}  // namespace implicam

#endif  // IMPLICAM_HPP
