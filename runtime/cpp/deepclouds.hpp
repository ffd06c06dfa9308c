// The inputs of a deepclouds model, for renderers written in C++: one header, C++17, the standard library alone.
//
// A model is an ONNX file that maps a stencil (10 x 225 values around a point) and six numbers to the multiple scattering there
// (docs/contract.md). This header makes both from any density grid:
//
//     deepclouds::Grid grid{{nx, ny, nz}, box_to_world, [&](int i, int j, int k) { return my_density(i, j, k); }};
//     deepclouds::Descriptor cloud(grid, scale);                      // once a volume
//     cloud.stencil(point, w, omega_sun, &stencils[row * 2250]);      // once a point, view and light; safe from many threads
//     deepclouds::aux(w, omega_sun, phase, albedo, tau, &auxes[row * 6]);
//     // run the network; then
//     double J = deepclouds::multiple_scattering(j[row], albedo, irradiance);
//
// Directions are unit vectors in world space: w along the camera ray's travel, away from the eye; omega_sun TOWARD the light.
// docs/renderer_authors.md tells what to call when; verify.cpp beside this file checks the header against the conformance vectors.

#ifndef DEEPCLOUDS_HPP
#define DEEPCLOUDS_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <functional>
#include <stdexcept>
#include <vector>

namespace deepclouds {

constexpr int levels = 10;
constexpr int points = 225;  // 5 x 5 x 9, x fastest
constexpr int stencil_size = levels * points;
constexpr int aux_size = 6;
constexpr double first_spacing = 0.5;  // of the finest level, in units of length

struct Vec3 {
  double x = 0, y = 0, z = 0;

  double operator[](int axis) const { return axis == 0 ? x : axis == 1 ? y : z; }
};

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(double s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline double norm(Vec3 a) { return std::sqrt(dot(a, a)); }

// The box of a grid in the world: a corner and the three edges that leave it along the grid's x, y and z axes. A 4 x 4 matrix that takes
// the unit cube to the world, points as columns, holds the edges in its first three columns and the corner in its fourth.
struct Box {
  Vec3 corner;
  std::array<Vec3, 3> edges;
};

// A density grid. Sample (i, j, k) sits at the CENTRE of its voxel, ((i + 0.5) / nx, (j + 0.5) / ny, (k + 0.5) / nz) of the box.
struct Grid {
  std::array<int, 3> resolution;                 // nx, ny, nz
  Box box;
  std::function<double(int, int, int)> density;  // of sample (i, j, k), finite and not negative; called once for each
};

// weight * HG(g1) + (1 - weight) * HG(g2); g > 0 scatters forward. A single lobe is {g, 0, 1}.
struct Phase {
  double g1 = 0, g2 = 0, weight = 1;
};

// Angle between w and omega_sun, radians, 0 looking into the sun. An arc cosine would lose the phase peak in single precision.
inline double gamma(Vec3 w, Vec3 omega_sun) { return std::atan2(norm(cross(w, omega_sun)), dot(w, omega_sun)); }

// One row of the network's input `aux`. `tau` is the optical depth from the point toward the light.
inline void aux(Vec3 w, Vec3 omega_sun, Phase phase, double albedo, double tau, float* row) {
  const double values[aux_size] = {gamma(w, omega_sun), phase.g1, phase.g2, phase.weight, albedo, std::log1p(tau)};
  for (int c = 0; c < aux_size; ++c) row[c] = static_cast<float>(values[c]);
}

// The source term J of multiple scattering, for the network's output j and the light's irradiance perpendicular to its direction.
inline double multiple_scattering(double j, double albedo, double irradiance) {
  constexpr double four_pi = 12.566370614359172;
  return albedo * albedo * irradiance * j / four_pi;
}

// The stencil's axes: z toward the light, x across the plane of light and view, y completing a right-handed frame. Where light and view
// are parallel any x perpendicular to the light serves; `azimuth`, radians, turns it there.
inline std::array<Vec3, 3> light_frame(Vec3 w, Vec3 omega_sun, double azimuth = 0) {
  const Vec3 across = cross(omega_sun, w);
  const double sine = norm(across);
  Vec3 x;
  if (sine > 1e-3) {
    x = (1 / sine) * across;
  } else {
    const double sign = omega_sun.z < 0 ? -1 : 1;  // Duff et al. 2017, JCGT 6(1)
    const double a = -1 / (sign + omega_sun.z);
    const double b = omega_sun.x * omega_sun.y * a;
    const Vec3 s{1 + sign * omega_sun.x * omega_sun.x * a, sign * b, -sign * omega_sun.x};
    const Vec3 t{b, sign + omega_sun.y * omega_sun.y * a, -omega_sun.y};
    x = std::cos(azimuth) * s + std::sin(azimuth) * t;
  }
  return {x, cross(omega_sun, x), omega_sun};
}

// Values on a regular lattice, x fastest, with the trilinear lookup that all levels share.
struct Lattice {
  std::array<int, 3> size{};
  std::vector<float> values;

  // `place` in samples: whole numbers are samples; clamped to the outermost ones.
  double lookup(Vec3 place) const {
    std::size_t low[3], high[3];
    double fraction[3];
    for (int a = 0; a < 3; ++a) {
      const int last = size[a] - 1;
      const double clamped = std::clamp(place[a], 0.0, static_cast<double>(last));
      const int floor = std::min(static_cast<int>(clamped), std::max(last - 1, 0));  // not negative, so that truncation is the floor
      low[a] = static_cast<std::size_t>(floor);
      high[a] = static_cast<std::size_t>(std::min(floor + 1, last));
      fraction[a] = clamped - floor;
    }
    const std::size_t row = static_cast<std::size_t>(size[0]), plane = row * static_cast<std::size_t>(size[1]);
    const auto along_x = [&](std::size_t start) {
      const double near = values[start + low[0]];
      return near + fraction[0] * (values[start + high[0]] - near);
    };
    const auto along_y = [&](std::size_t start) {
      const double near = along_x(start + low[1] * row);
      return near + fraction[1] * (along_x(start + high[1] * row) - near);
    };
    const double near = along_y(low[2] * plane);
    return near + fraction[2] * (along_y(high[2] * plane) - near);
  }
};

// The stencils of one medium, sigma_t = scale * density in a box and zero outside of it. Build it once a volume (or frame of a sequence);
// every method is const and may be called from many threads.
class Descriptor {
 public:
  // Unit of length and cell origin as the contract defines them.
  Descriptor(const Grid& grid, double scale) : Descriptor(grid, scale, Frame{}) {}

  // Those of another frame: keep them fixed for a sequence, so that nothing flickers when the cloud changes.
  Descriptor(const Grid& grid, double scale, double unit, Vec3 origin) : Descriptor(grid, scale, Frame{true, unit, origin}) {}

  double unit() const { return unit_; }        // mean free path at the extinction-weighted mean extinction, world units
  Vec3 origin() const { return origin_; }      // on a corner of the cells of every filtered level
  int raw_levels() const { return raw_; }      // levels whose spacing is no larger than a voxel: they read the field itself

  // Extinction at a world point, 1 / world unit.
  double sigma_t(Vec3 point) const { return scale_ * density_at(to_box(point)); }

  // Writes the 2,250 values [level][z][y][x], the finest level first, each sigma_t * unit. `mirrored` looks at the cloud's mirror image
  // across the plane of light and view, for which J is the same.
  void stencil(Vec3 point, Vec3 w, Vec3 omega_sun, float* out, double azimuth = 0, bool mirrored = false) const {
    auto axes = light_frame(w, omega_sun, azimuth);
    if (mirrored) axes[0] = -1.0 * axes[0];
    for (int level = 0; level < levels; ++level) {
      const double spacing = spacing_of(level);
      // A lookup is affine in the offsets: take point and axes to the level's own coordinates once.
      Vec3 middle, step[3];
      if (level < raw_) {
        middle = to_box(point);
        for (int a = 0; a < 3; ++a) step[a] = spacing * direction_to_box(axes[a]);
      } else {
        middle = to_cells(point, level);
        for (int a = 0; a < 3; ++a) step[a] = along_grid(axes[a]);
      }
      for (int z = -2; z <= 6; ++z) {
        for (int y = -2; y <= 2; ++y) {
          const Vec3 row = middle + double(z) * step[2] + double(y) * step[1];
          for (int x = -2; x <= 2; ++x) {
            const Vec3 place = row + double(x) * step[0];
            const double value = level < raw_ ? density_at(place) : filtered_[level - raw_].lookup(place);
            *out++ = static_cast<float>(value * scale_ * unit_);
          }
        }
      }
    }
  }

  // Optical depth from a world point along a unit vector to infinity: the midpoint rule with steps of half a voxel. Your renderer's own
  // transmittance serves as well, if it has no noise to speak of.
  double optical_depth(Vec3 point, Vec3 direction) const {
    const Vec3 from = to_box(point), along = direction_to_box(direction);
    double enter = 0, leave = 1e300;
    for (int a = 0; a < 3; ++a) {
      if (std::abs(along[a]) < 1e-300) {
        if (from[a] < 0 || from[a] > 1) return 0;
        continue;
      }
      const double t0 = -from[a] / along[a], t1 = (1 - from[a]) / along[a];
      enter = std::max(enter, std::min(t0, t1));
      leave = std::min(leave, std::max(t0, t1));
    }
    if (leave <= enter) return 0;
    const double steps = std::ceil((leave - enter) / (0.5 * voxel_)), width = (leave - enter) / steps;
    double sum = 0;
    for (double i = 0.5; i < steps; ++i) sum += density_at(from + (enter + i * width) * along);
    return scale_ * sum * width;
  }

 private:
  struct Frame {
    bool given = false;
    double unit = 1;
    Vec3 origin;
  };

  Descriptor(const Grid& grid, double scale, const Frame& frame) : box_(grid.box), scale_(scale) {
    require(std::isfinite(frame.unit) && frame.unit > 0, "deepclouds: the unit of length must be positive and finite");
    require(std::isfinite(scale) && scale >= 0, "deepclouds: the extinction's scale must be finite and not negative");
    for (int a = 0; a < 3; ++a) {
      require(grid.resolution[a] >= 1, "deepclouds: a grid needs a sample along each axis");
      length_[a] = norm(box_.edges[a]);
      require(length_[a] > 0, "deepclouds: the grid's box has no volume");
      axes_[a] = (1 / length_[a]) * box_.edges[a];
    }
    for (int a = 0; a < 3; ++a) {
      const bool perpendicular = std::abs(dot(axes_[a], axes_[(a + 1) % 3])) < 1e-4;
      require(perpendicular, "deepclouds: the grid's axes are not perpendicular; resample the sheared volume to a box first");
    }
    voxel_ = std::min({length_[0] / grid.resolution[0], length_[1] / grid.resolution[1], length_[2] / grid.resolution[2]});
    read(grid);
    double mass = 0, square = 0;
    const Vec3 centre = centre_of_mass(mass, square);
    const double mean = mass > 0 ? scale_ * square / mass : 0;
    origin_ = frame.given ? frame.origin : centre;
    unit_ = frame.given ? frame.unit : mean > 0 ? 1 / mean : 1;
    while (raw_ < levels && spacing_of(raw_) <= voxel_) ++raw_;
    filter();
  }

  static void require(bool holds, const char* message) {
    if (!holds) throw std::invalid_argument(message);
  }

  double spacing_of(int level) const { return first_spacing * std::ldexp(unit_, level); }

  void read(const Grid& grid) {
    field_.size = grid.resolution;
    const auto [nx, ny, nz] = grid.resolution;
    field_.values.reserve(static_cast<std::size_t>(nx) * ny * nz);
    for (int k = 0; k < nz; ++k) {
      for (int j = 0; j < ny; ++j) {
        for (int i = 0; i < nx; ++i) {
          const double value = grid.density(i, j, k);
          require(std::isfinite(value) && value >= 0, "deepclouds: densities must be finite and not negative");
          field_.values.push_back(static_cast<float>(value));
        }
      }
    }
  }

  // World point of the density's centre of mass, which empty padding does not move; sums of the density and of its square.
  Vec3 centre_of_mass(double& mass, double& square) const {
    double moment[3] = {0, 0, 0};
    std::size_t at = 0;
    for (int k = 0; k < field_.size[2]; ++k) {
      for (int j = 0; j < field_.size[1]; ++j) {
        for (int i = 0; i < field_.size[0]; ++i) {
          const double value = field_.values[at++];
          mass += value;
          square += value * value;
          moment[0] += value * (i + 0.5);
          moment[1] += value * (j + 0.5);
          moment[2] += value * (k + 0.5);
        }
      }
    }
    Vec3 centre = box_.corner;
    for (int a = 0; a < 3; ++a) {
      centre = centre + (mass > 0 ? moment[a] / mass / field_.size[a] : 0.5) * box_.edges[a];
    }
    return centre;
  }

  // The first filtered level holds exact averages of the trilinear field over cells of its spacing; each further one averages 2 x 2 x 2
  // cells, which is the same as averaging the field itself. A rim of zeros lets a clamped lookup read zero beyond the cells.
  void filter() {
    Lattice cells = field_;
    std::array<int, 3> first{};
    for (int level = raw_; level < levels; ++level) {
      const double spacing = spacing_of(level);
      for (int a = 0; a < 3; ++a) {
        const int count = cells.size[a];
        if (level == raw_) {
          const auto average = cell_weights(count, length_[a], dot(axes_[a], box_.corner - origin_), spacing, first[a]);
          cells = contracted(cells, a, average);
        } else {
          const int before = first[a] & 1;  // holds for negative numbers too
          first[a] = (first[a] - before) / 2;
          std::vector<Weights> halves((before + count + 1) / 2);
          for (int i = 0; i < count; ++i) {
            Weights& half = halves[(before + i) / 2];
            if (half.weight.empty()) half.start = i;
            half.weight.push_back(0.5);
          }
          cells = contracted(cells, a, halves);
        }
      }
      filtered_.push_back(with_rim(cells));
      first_.push_back(first);
    }
  }

  // Samples `start`, `start + 1`, ... that a cell averages along one axis, and their weights.
  struct Weights {
    int start = 0;
    std::vector<double> weight;
  };

  // Integral, from the box's lower face to `edge`, of the hat of sample `i` of `n`; the outermost hats go on as constants to the faces.
  // In voxels.
  static double hat_integral(int i, int n, double edge) {
    if (n == 1) return edge;
    const double x = edge - (i + 0.5);
    const double up = std::clamp(x + 1, 0.0, 1.0), down = std::clamp(x, 0.0, 1.0);
    const double rise = i > 0 ? 0.5 * up * up : std::clamp(edge, 0.0, 0.5);
    const double fall = i < n - 1 ? down - 0.5 * down * down : std::clamp(x, 0.0, 0.5);
    return rise + fall;
  }

  // Exact averages, over cells of `spacing`, of the clamped piecewise linear interpolant along one axis. `start` is the coordinate of the
  // box's lower face, from the cells' origin; `first` becomes the number of the first cell.
  static std::vector<Weights> cell_weights(int samples, double length, double start, double spacing, int& first) {
    const double voxel = length / samples;
    first = static_cast<int>(std::floor(start / spacing + 1e-9));
    const int end = std::max(first + 1, static_cast<int>(std::ceil((start + length) / spacing - 1e-9)));
    std::vector<Weights> cells(end - first);
    for (int c = 0; c < end - first; ++c) {
      const double low = std::clamp(((first + c) * spacing - start) / voxel, 0.0, double(samples));
      const double high = std::clamp(((first + c + 1) * spacing - start) / voxel, 0.0, double(samples));
      Weights& cell = cells[c];
      cell.start = std::clamp(static_cast<int>(std::floor(low - 0.5)), 0, samples - 1);
      const int last = std::clamp(static_cast<int>(std::ceil(high - 0.5)), 0, samples - 1);
      for (int i = cell.start; i <= last; ++i) {
        cell.weight.push_back((hat_integral(i, samples, high) - hat_integral(i, samples, low)) * voxel / spacing);
      }
    }
    return cells;
  }

  // Replaces the samples along one axis by weighted sums of them.
  static Lattice contracted(const Lattice& from, int axis, const std::vector<Weights>& cells) {
    Lattice to;
    to.size = from.size;
    to.size[axis] = static_cast<int>(cells.size());
    std::size_t stride = 1, outer = 1;
    for (int a = 0; a < axis; ++a) stride *= from.size[a];
    for (int a = axis + 1; a < 3; ++a) outer *= from.size[a];
    to.values.resize(stride * cells.size() * outer);
    std::vector<double> sum(stride);
    for (std::size_t o = 0; o < outer; ++o) {
      for (std::size_t c = 0; c < cells.size(); ++c) {
        std::fill(sum.begin(), sum.end(), 0.0);
        for (std::size_t i = 0; i < cells[c].weight.size(); ++i) {
          const float* source = &from.values[(o * from.size[axis] + cells[c].start + i) * stride];
          for (std::size_t s = 0; s < stride; ++s) sum[s] += cells[c].weight[i] * source[s];
        }
        std::transform(sum.begin(), sum.end(), &to.values[(o * cells.size() + c) * stride], [](double v) { return static_cast<float>(v); });
      }
    }
    return to;
  }

  static Lattice with_rim(const Lattice& cells) {
    Lattice rimmed;
    const auto [nx, ny, nz] = cells.size;
    rimmed.size = {nx + 2, ny + 2, nz + 2};
    rimmed.values.assign(static_cast<std::size_t>(nx + 2) * (ny + 2) * (nz + 2), 0.0f);
    for (int k = 0; k < nz; ++k) {
      for (int j = 0; j < ny; ++j) {
        const auto row = cells.values.begin() + (static_cast<std::ptrdiff_t>(k) * ny + j) * nx;
        std::copy(row, row + nx, rimmed.values.begin() + ((static_cast<std::ptrdiff_t>(k) + 1) * (ny + 2) + j + 1) * (nx + 2) + 1);
      }
    }
    return rimmed;
  }

  Vec3 along_grid(Vec3 v) const { return {dot(axes_[0], v), dot(axes_[1], v), dot(axes_[2], v)}; }

  // World to the unit cube of the box.
  Vec3 direction_to_box(Vec3 v) const {
    const Vec3 along = along_grid(v);
    return {along.x / length_[0], along.y / length_[1], along.z / length_[2]};
  }
  Vec3 to_box(Vec3 point) const { return direction_to_box(point - box_.corner); }

  // World to the samples of a filtered level: cell c has its centre at c + 0.5 from the origin, and the rim adds one.
  Vec3 to_cells(Vec3 point, int level) const {
    const auto& first = first_[level - raw_];
    const Vec3 shift{0.5 - first[0], 0.5 - first[1], 0.5 - first[2]};
    return (1 / spacing_of(level)) * along_grid(point - origin_) + shift;
  }

  // Density at a point of the unit cube: trilinear between samples, constant beyond the outermost ones, and a hard cut at the box.
  double density_at(Vec3 unit) const {
    for (int a = 0; a < 3; ++a) {
      if (!(unit[a] >= 0 && unit[a] <= 1)) return 0;
    }
    return field_.lookup({unit.x * field_.size[0] - 0.5, unit.y * field_.size[1] - 0.5, unit.z * field_.size[2] - 0.5});
  }

  Box box_;
  double scale_ = 0, unit_ = 1, voxel_ = 0;
  Vec3 origin_;
  std::array<Vec3, 3> axes_{};
  std::array<double, 3> length_{};
  int raw_ = 0;
  Lattice field_;
  std::vector<Lattice> filtered_;
  std::vector<std::array<int, 3>> first_;
};

}  // namespace deepclouds

#endif  // DEEPCLOUDS_HPP
