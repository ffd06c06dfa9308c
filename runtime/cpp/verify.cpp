// Checks deepclouds.hpp against the conformance vectors; a pattern for checking your own implementation.
//
//     g++ -std=c++17 -O2 verify.cpp -o verify && ./verify ../deepclouds_runtime/data/conformance.bin
//
// Prints the largest differences. Exit code 0: all within the tolerances; 1: not; 2: the file cannot be read.
// The file is little-endian, as is every machine this is likely to run on; its layout: docs/renderer_authors.md.

#include "deepclouds.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <ctime>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

using deepclouds::Vec3;

struct Medium {
  double scale, unit, origin[3], is_default, first, count;
};

struct Query {
  float point[3], w[3], omega_sun[3], g1, g2, weight, albedo, tau;
};

constexpr int digest_count = 5;

struct Vectors {
  struct {
    char magic[8];
    std::int32_t nx, ny, nz, media, queries, full;
    double stencil_tolerance, digest_tolerance, aux_tolerance;
  } header;
  double to_world[16];  // row after row
  std::vector<Medium> media;
  std::vector<float> density;
  std::vector<Query> queries;
  std::vector<float> aux, digests;
  std::vector<std::int32_t> full_rows;
  std::vector<float> full;
};

template <class T>
void read(std::ifstream& file, T* to, std::size_t count) {
  file.read(reinterpret_cast<char*>(to), static_cast<std::streamsize>(count * sizeof(T)));
  if (!file) throw std::runtime_error("the file is cut short");
}

template <class T>
void read(std::ifstream& file, std::vector<T>& to, std::size_t count) {
  to.resize(count);
  read(file, to.data(), count);
}

Vectors read_vectors(const char* path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error("the file cannot be opened");
  Vectors v;
  static_assert(sizeof(v.header) == 56 && sizeof(Medium) == 64 && sizeof(Query) == 56, "the structures mirror the file");
  read(file, &v.header, 1);
  if (std::memcmp(v.header.magic, "DCCONF01", 8) != 0) throw std::runtime_error("these are no conformance vectors of this version");
  const auto n = static_cast<std::size_t>(v.header.queries), m = static_cast<std::size_t>(v.header.full);
  read(file, v.to_world, 16);
  read(file, v.media, static_cast<std::size_t>(v.header.media));
  read(file, v.density, static_cast<std::size_t>(v.header.nx) * v.header.ny * v.header.nz);
  read(file, v.queries, n);
  read(file, v.aux, n * deepclouds::aux_size);
  read(file, v.digests, n * deepclouds::levels * digest_count);
  read(file, v.full_rows, m);
  read(file, v.full, m * deepclouds::stencil_size);
  return v;
}

// Five weighted means of the 225 values of a level: the density, where it lies along x, y and z, and a fixed scramble.
void digest(const float* level, double* result) {
  std::fill(result, result + digest_count, 0.0);
  std::uint32_t scramble = 0;
  for (int i = 0; i < deepclouds::points; ++i, scramble += 2654435761u) {
    const int x = i % 5 - 2, y = i / 5 % 5 - 2, z = i / 25 - 2;
    const double weights[digest_count] = {1, x / 2.0, y / 2.0, z / 6.0, scramble / 2147483648.0 - 1};
    for (int d = 0; d < digest_count; ++d) result[d] += weights[d] * level[i] / deepclouds::points;
  }
}

Vec3 vec(const float* v) { return {v[0], v[1], v[2]}; }

struct Largest {
  double value = 0;

  void add(double a, double b) {
    const double difference = std::abs(a - b);
    if (std::isnan(difference) || difference > value) value = difference;  // a NaN stays, and fails
  }
};

bool report(const char* name, Largest largest, double tolerance) {
  const bool passed = largest.value <= tolerance;
  std::printf("%-8s largest difference %8.2g, tolerance %.0e: %s\n", name, largest.value, tolerance, passed ? "ok" : "FAILED");
  return passed;
}

int verify(const char* path) {
  const Vectors v = read_vectors(path);
  deepclouds::Grid grid;
  grid.resolution = {v.header.nx, v.header.ny, v.header.nz};
  grid.density = [&](int i, int j, int k) { return v.density[(static_cast<std::size_t>(k) * v.header.ny + j) * v.header.nx + i]; };
  const auto column = [&](int c) { return Vec3{v.to_world[c], v.to_world[4 + c], v.to_world[8 + c]}; };
  grid.box = {column(3), {column(0), column(1), column(2)}};

  Largest stencil, digests, aux, tau;
  std::vector<float> values(v.queries.size() * deepclouds::stencil_size);
  std::clock_t spent = 0;
  for (const Medium& medium : v.media) {
    const Vec3 origin{medium.origin[0], medium.origin[1], medium.origin[2]};
    const auto cloud = medium.is_default != 0 ? deepclouds::Descriptor(grid, medium.scale)
                                              : deepclouds::Descriptor(grid, medium.scale, medium.unit, origin);
    const auto first = static_cast<std::size_t>(medium.first), end = first + static_cast<std::size_t>(medium.count);
    const std::clock_t start = std::clock();
    for (std::size_t i = first; i < end; ++i) {
      const Query& q = v.queries[i];
      cloud.stencil(vec(q.point), vec(q.w), vec(q.omega_sun), &values[i * deepclouds::stencil_size]);
    }
    spent += std::clock() - start;
    for (std::size_t i = first; i < end; ++i) {
      const Query& q = v.queries[i];
      float row[deepclouds::aux_size];
      deepclouds::aux(vec(q.w), vec(q.omega_sun), {q.g1, q.g2, q.weight}, q.albedo, q.tau, row);
      for (int c = 0; c < deepclouds::aux_size; ++c) aux.add(row[c], v.aux[i * deepclouds::aux_size + c]);
      tau.add(std::log1p(cloud.optical_depth(vec(q.point), vec(q.omega_sun))), std::log1p(q.tau));
      for (int k = 0; k < deepclouds::levels; ++k) {
        double found[digest_count];
        digest(&values[i * deepclouds::stencil_size + k * deepclouds::points], found);
        for (int d = 0; d < digest_count; ++d) digests.add(found[d], v.digests[(i * deepclouds::levels + k) * digest_count + d]);
      }
    }
  }
  for (std::size_t f = 0; f < v.full_rows.size(); ++f) {
    const float* found = &values[static_cast<std::size_t>(v.full_rows[f]) * deepclouds::stencil_size];
    for (int i = 0; i < deepclouds::stencil_size; ++i) stencil.add(found[i], v.full[f * deepclouds::stencil_size + i]);
  }

  std::printf("%zu queries, %.3g microseconds of processor time a stencil\n", v.queries.size(),
              1e6 * double(spent) / CLOCKS_PER_SEC / double(v.queries.size()));
  bool passed = report("stencil", stencil, v.header.stencil_tolerance);
  passed &= report("digest", digests, v.header.digest_tolerance);
  passed &= report("aux", aux, v.header.aux_tolerance);
  passed &= report("tau", tau, 0.05);  // as log1p(tau): a march of half a voxel against the integral
  return passed ? 0 : 1;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "usage: %s conformance.bin\n", argv[0]);
    return 2;
  }
  try {
    return verify(argv[1]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", argv[1], error.what());
    return 2;
  }
}
