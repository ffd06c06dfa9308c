// deepclouds.volume._openvdb: what a .vdb file holds, one float grid as a dense array or as bricks, and either as a .vdb file.
//
// Everything that OpenVDB throws reaches Python as VdbError with OpenVDB's own words. The Python side (deepclouds/volume/vdb.py)
// decides which grids are acceptable; here lies only what needs the C++ library.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include <openvdb/io/Archive.h>
#include <openvdb/io/GridDescriptor.h>
#include <openvdb/math/Maps.h>
#include <openvdb/openvdb.h>
#include <openvdb/tools/Dense.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <memory>
#include <new>
#include <stdexcept>
#include <string>
#include <vector>

namespace nb = nanobind;

namespace {

struct VdbError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

struct Entry {
    openvdb::io::GridDescriptor descriptor;
    openvdb::GridBase::Ptr grid;  // empty until read; null for a type that this build of OpenVDB does not know
};

// Reads a file grid by grid. openvdb::io::File would do, but it neither notices that a file ends too early (it goes on with zeros)
// nor can it list a file that has one grid of an unknown type. Here the stream itself throws at the end of the file.
class Reader : public openvdb::io::Archive {
public:
    explicit Reader(const std::string& path) : stream_(path, std::ios::binary) {
        if (!stream_) {
            throw VdbError("the file cannot be opened");
        }
        stream_.seekg(0, std::ios::end);
        size_ = static_cast<std::int64_t>(stream_.tellg());
        stream_.seekg(0);
        stream_.exceptions(std::ios::failbit | std::ios::badbit | std::ios::eofbit);
        readHeader(stream_);
        if (!inputHasGridOffsets()) {
            throw VdbError("the file is a stream without grid offsets; open and save it once with an OpenVDB tool");
        }
        setFormatVersion(stream_);
        setLibraryVersion(stream_);
        setDataCompression(stream_);
        openvdb::MetaMap file_metadata;
        file_metadata.readMeta(stream_);
        const std::int32_t count = readGridCount(stream_);
        if (count < 0) {
            throw VdbError("the file's table of grids is damaged");
        }
        for (std::int32_t i = 0; i < count; ++i) {
            Entry entry;
            try {
                entry.grid = entry.descriptor.read(stream_);
            } catch (const openvdb::LookupError&) {
                // The type's name is read before the type is looked up; the three offsets that follow it are read here.
                std::int64_t offsets[3];
                stream_.read(reinterpret_cast<char*>(offsets), sizeof offsets);
                entry.descriptor.setGridPos(offsets[0]);
                entry.descriptor.setBlockPos(offsets[1]);
                entry.descriptor.setEndPos(offsets[2]);
            }
            const auto& d = entry.descriptor;
            if (d.getGridPos() <= 0 || d.getEndPos() < d.getGridPos() || d.getEndPos() > size_) {
                throw VdbError("the file ends before its grid '" + d.gridName() + "' does");
            }
            entries_.push_back(entry);
            if (i + 1 < count) {
                d.seekToEnd(stream_);
            }
        }
    }

    const std::vector<Entry>& entries() const { return entries_; }

    const Entry& at(std::size_t index) const {
        if (index >= entries_.size()) {
            throw VdbError("the file has no grid number " + std::to_string(index));
        }
        return entries_[index];
    }

    // The grid with its tree; an instance shares the tree of the grid that it names.
    openvdb::GridBase::Ptr load(std::size_t index) {
        const Entry& entry = at(index);
        const auto& d = entry.descriptor;
        if (!entry.grid) {
            throw VdbError("OpenVDB does not know the grid type '" + d.gridType() + "'");
        }
        fill(entry);
        if (d.isInstance()) {
            for (const Entry& parent : entries_) {
                if (parent.descriptor.uniqueName() == d.instanceParentName() && parent.grid && !parent.descriptor.isInstance()) {
                    fill(parent);
                    entry.grid->setTree(parent.grid->baseTreePtr());
                    return entry.grid;
                }
            }
            throw VdbError("the grid '" + d.gridName() + "' shares the voxels of '" + d.instanceParentName() + "', which the file lacks");
        }
        return entry.grid;
    }

private:
    void fill(const Entry& entry) {
        entry.descriptor.seekToGrid(stream_);
        readGrid(entry.grid, entry.descriptor, stream_);
        // What the writer counted is compared with what was read: a file damaged in the middle may still parse.
        const auto counted = entry.grid->getMetadata<openvdb::Int64Metadata>(openvdb::GridBase::META_FILE_VOXEL_COUNT);
        if (counted && !entry.descriptor.isInstance()) {
            const auto found = static_cast<std::int64_t>(entry.grid->activeVoxelCount());
            if (found != counted->value()) {
                throw VdbError("the grid '" + entry.descriptor.gridName() + "' should have " + std::to_string(counted->value()) +
                               " active voxels and has " + std::to_string(found) + ": the file is damaged");
            }
        }
        const auto lower = entry.grid->getMetadata<openvdb::Vec3IMetadata>(openvdb::GridBase::META_FILE_BBOX_MIN);
        const auto upper = entry.grid->getMetadata<openvdb::Vec3IMetadata>(openvdb::GridBase::META_FILE_BBOX_MAX);
        if (lower && upper && !entry.descriptor.isInstance()) {
            const openvdb::CoordBBox box = entry.grid->evalActiveVoxelBoundingBox();
            if (!box.empty() && (box.min().asVec3i() != lower->value() || box.max().asVec3i() != upper->value())) {
                throw VdbError("the grid '" + entry.descriptor.gridName() + "' does not fill the box that its file states: the file is damaged");
            }
        }
    }

    std::ifstream stream_;
    std::int64_t size_ = 0;
    std::vector<Entry> entries_;
};

// Names and messages may hold bytes that are not UTF-8; they are replaced, never an error.
nb::str text(const std::string& bytes) {
    return nb::steal<nb::str>(PyUnicode_DecodeUTF8(bytes.data(), static_cast<Py_ssize_t>(bytes.size()), "replace"));
}

nb::object metadata_value(const openvdb::Metadata& metadata) {
    if (const auto* m = dynamic_cast<const openvdb::StringMetadata*>(&metadata)) {
        return text(m->value());
    }
    if (const auto* m = dynamic_cast<const openvdb::BoolMetadata*>(&metadata)) return nb::cast(m->value());
    if (const auto* m = dynamic_cast<const openvdb::Int32Metadata*>(&metadata)) return nb::cast(m->value());
    if (const auto* m = dynamic_cast<const openvdb::Int64Metadata*>(&metadata)) return nb::cast(m->value());
    if (const auto* m = dynamic_cast<const openvdb::FloatMetadata*>(&metadata)) return nb::cast(m->value());
    if (const auto* m = dynamic_cast<const openvdb::DoubleMetadata*>(&metadata)) return nb::cast(m->value());
    return text(metadata.str());
}

nb::dict header(const Entry& entry) {
    nb::dict out;
    out["name"] = text(entry.descriptor.gridName());
    out["unique_name"] = text(openvdb::io::GridDescriptor::nameAsString(entry.descriptor.uniqueName()));
    out["value_type"] = text(entry.grid ? entry.grid->valueType() : entry.descriptor.gridType());
    out["half"] = entry.descriptor.saveFloatAsHalf();
    out["known"] = static_cast<bool>(entry.grid);
    return out;
}

// Row-major 4 x 4 in the column-vector convention (OpenVDB multiplies rows from the left); None when the map is not affine.
nb::object index_to_world(const openvdb::math::Transform& transform) {
    if (!transform.isLinear()) {
        return nb::none();
    }
    const openvdb::Mat4d m = transform.baseMap()->getAffineMap()->getMat4();
    nb::list rows;
    for (int r = 0; r < 4; ++r) {
        nb::list row;
        for (int c = 0; c < 4; ++c) {
            row.append(m(c, r));
        }
        rows.append(row);
    }
    return rows;
}

nb::dict describe(const Entry& entry, const openvdb::GridBase& grid) {
    nb::dict out = header(entry);
    out["grid_class"] = text(openvdb::GridBase::gridClassToString(grid.getGridClass()));
    out["transform_type"] = text(grid.transform().mapType());
    out["index_to_world"] = index_to_world(grid.transform());
    const openvdb::Vec3d size = grid.transform().isLinear() ? grid.voxelSize() : openvdb::Vec3d(0.0);
    out["voxel_size"] = nb::make_tuple(size.x(), size.y(), size.z());
    out["active_voxels"] = static_cast<std::uint64_t>(grid.activeVoxelCount());
    const openvdb::CoordBBox box = grid.evalActiveVoxelBoundingBox();
    if (box.empty()) {
        out["index_box"] = nb::none();
    } else {
        out["index_box"] = nb::make_tuple(nb::make_tuple(box.min().x(), box.min().y(), box.min().z()),
                                          nb::make_tuple(box.max().x(), box.max().y(), box.max().z()));
    }
    nb::dict metadata;
    for (auto it = grid.beginMeta(); it != grid.endMeta(); ++it) {
        if (it->second) {
            metadata[text(it->first)] = metadata_value(*it->second);
        }
    }
    out["metadata"] = metadata;
    return out;
}

nb::list read_headers(const std::string& path) {
    const Reader reader(path);
    nb::list out;
    for (const Entry& entry : reader.entries()) {
        out.append(header(entry));
    }
    return out;
}

nb::dict describe_grid(const std::string& path, std::size_t index) {
    Reader reader(path);
    openvdb::GridBase::Ptr grid;
    {
        nb::gil_scoped_release release;
        grid = reader.load(index);
    }
    return describe(reader.at(index), *grid);
}

using DenseArray = nb::ndarray<nb::numpy, float, nb::ndim<3>, nb::c_contig>;
// Bricks, or voxels of several components.
using BrickArray = nb::ndarray<nb::numpy, float, nb::ndim<4>, nb::c_contig>;
using PlaceArray = nb::ndarray<nb::numpy, std::int32_t, nb::ndim<2>, nb::c_contig>;
using Freed = std::unique_ptr<void, decltype(&std::free)>;

constexpr int EDGE = 8;
constexpr std::size_t BRICK = EDGE * EDGE * EDGE;

// Extents of a box. Its corners are 32-bit integers: its extents need 64, its volume may need more.
struct Extent {
    std::uint64_t n[3];
    double voxels = 1;

    explicit Extent(const openvdb::CoordBBox& box) {
        for (int axis = 0; axis < 3; ++axis) {
            n[axis] = static_cast<std::uint64_t>(static_cast<std::int64_t>(box.max()[axis]) - box.min()[axis] + 1);
            voxels *= static_cast<double>(n[axis]);
        }
    }

    std::string text() const { return std::to_string(n[0]) + " x " + std::to_string(n[1]) + " x " + std::to_string(n[2]); }
};

// The bricks of a grid that hold something: places (x, y, z) in bricks from the box's corner on, and values, z slowest.
struct Bricks {
    std::vector<std::array<std::int32_t, 3>> places;
    Freed values{nullptr, &std::free};
};

// Places of the bricks that nodes of the tree with any value but 0 reach; sorted along z, y, x. Gives up with false beyond `most`.
bool candidates(const openvdb::FloatGrid& grid, const openvdb::CoordBBox& box, std::size_t most, std::vector<std::array<std::int32_t, 3>>& out) {
    const auto reach = [&](openvdb::CoordBBox node) {
        node.intersect(box);
        if (node.empty()) {
            return true;
        }
        std::int64_t low[3], high[3];
        double count = 1;
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = (static_cast<std::int64_t>(node.min()[axis]) - box.min()[axis]) / EDGE;
            high[axis] = (static_cast<std::int64_t>(node.max()[axis]) - box.min()[axis]) / EDGE;
            count *= static_cast<double>(high[axis] - low[axis] + 1);
        }
        // A leaf may reach eight bricks that its neighbours reach too.
        if (static_cast<double>(out.size()) + count > 8.0 * static_cast<double>(most)) {
            return false;
        }
        for (std::int64_t z = low[2]; z <= high[2]; ++z) {
            for (std::int64_t y = low[1]; y <= high[1]; ++y) {
                for (std::int64_t x = low[0]; x <= high[0]; ++x) {
                    out.push_back({static_cast<std::int32_t>(x), static_cast<std::int32_t>(y), static_cast<std::int32_t>(z)});
                }
            }
        }
        return true;
    };
    const auto& tree = grid.tree();
    for (auto leaf = tree.cbeginLeaf(); leaf; ++leaf) {
        if (!reach(leaf->getNodeBoundingBox())) {
            return false;
        }
    }
    auto tile = tree.cbeginValueAll();
    tile.setMaxDepth(openvdb::FloatTree::ValueAllCIter::LEAF_DEPTH - 1);
    for (; tile; ++tile) {
        if (*tile != 0.0f && !reach(tile.getBoundingBox())) {
            return false;
        }
    }
    std::sort(out.begin(), out.end(), [](const auto& a, const auto& b) {
        return std::lexicographical_compare(a.rbegin(), a.rend(), b.rbegin(), b.rend());
    });
    out.erase(std::unique(out.begin(), out.end()), out.end());
    return out.size() <= most;
}

// Bricks of the box with any value but 0, whether active or not; of values only where `keep` says so. False beyond `most` bricks.
bool collect(const openvdb::FloatGrid& grid, const openvdb::CoordBBox& box, std::size_t most, bool keep, Bricks& out) {
    using Dense = openvdb::tools::Dense<float, openvdb::tools::LayoutXYZ>;
    std::vector<std::array<std::int32_t, 3>> reached;
    if (!candidates(grid, box, most, reached)) {
        return false;
    }
    const auto resize = [&out](std::size_t count) {
        void* larger = std::realloc(out.values.get(), std::max<std::size_t>(count, 1) * BRICK * sizeof(float));
        if (!larger) {
            throw std::bad_alloc();
        }
        static_cast<void>(out.values.release());
        out.values.reset(larger);
    };
    // Memory that is never written costs nothing, and what is left over is given back.
    resize(keep ? reached.size() : 1);
    std::vector<float> part(BRICK);
    for (const auto& place : reached) {
        openvdb::Coord low, high;
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = box.min()[axis] + EDGE * place[axis];
            high[axis] = static_cast<int>(std::min<std::int64_t>(static_cast<std::int64_t>(low[axis]) + EDGE - 1, box.max()[axis]));
        }
        const openvdb::CoordBBox inside(low, high);
        float* const to = static_cast<float*>(out.values.get()) + (keep ? out.places.size() * BRICK : 0);
        const bool whole = inside.volume() == BRICK;
        Dense dense(inside, whole ? to : part.data());
        openvdb::tools::copyToDense(grid, dense, true);
        if (!whole) {
            std::fill(to, to + BRICK, 0.0f);
            const openvdb::Coord n = inside.dim();
            for (int z = 0; z < n.z(); ++z) {
                for (int y = 0; y < n.y(); ++y) {
                    const float* const row = part.data() + (static_cast<std::size_t>(z) * n.y() + y) * n.x();
                    std::copy(row, row + n.x(), to + (z * EDGE + y) * EDGE);
                }
            }
        }
        if (std::any_of(to, to + BRICK, [](float value) { return value != 0.0f; })) {
            out.places.push_back(place);
        }
    }
    if (keep) {
        resize(out.places.size());
    }
    return true;
}

openvdb::FloatGrid::Ptr load_floats(Reader& reader, std::size_t index) {
    openvdb::GridBase::Ptr base;
    {
        nb::gil_scoped_release release;
        base = reader.load(index);
    }
    auto grid = openvdb::gridPtrCast<openvdb::FloatGrid>(base);
    if (!grid) {
        throw VdbError("the grid '" + base->getName() + "' holds " + base->valueType() + " values, not float");
    }
    return grid;
}

// Number of bricks that hold something; None for a grid without active voxels, and for one that has more than `max_voxels` in them.
nb::object count_bricks(const std::string& path, std::size_t index, std::uint64_t max_voxels) {
    Reader reader(path);
    const auto grid = load_floats(reader, index);
    const openvdb::CoordBBox box = grid->evalActiveVoxelBoundingBox();
    Bricks bricks;
    bool fits = false;
    if (!box.empty()) {
        nb::gil_scoped_release release;
        fits = collect(*grid, box, max_voxels / BRICK, false, bricks);
    }
    return fits ? nb::cast(bricks.places.size()) : nb::none();
}

// A float grid, cropped to its active voxels, as (description, dense array or None, places or None, values or None): dense up to
// `dense_voxels`, beyond in bricks if those take at most half of the box, or else dense up to `max_voxels`.
nb::tuple read_floats(const std::string& path, std::size_t index, std::uint64_t dense_voxels, std::uint64_t max_voxels, std::uint64_t max_box) {
    Reader reader(path);
    auto grid = load_floats(reader, index);
    nb::dict info = describe(reader.at(index), *grid);
    info["background"] = grid->background();
    const openvdb::CoordBBox box = grid->evalActiveVoxelBoundingBox();
    if (box.empty()) {
        return nb::make_tuple(info, nb::none(), nb::none(), nb::none());
    }
    const Extent extent(box);
    Bricks bricks;
    bool sparse = false;
    if (extent.voxels > static_cast<double>(dense_voxels) && extent.voxels <= static_cast<double>(max_box)) {
        nb::gil_scoped_release release;
        sparse = collect(*grid, box, max_voxels / BRICK, true, bricks);
        const double kept = static_cast<double>(bricks.places.size() * BRICK);
        sparse = sparse && (2 * kept <= extent.voxels || extent.voxels > static_cast<double>(max_voxels));
    }
    if (sparse) {
        const std::size_t count = bricks.places.size();
        auto* places = new std::int32_t[3 * count];
        const nb::capsule places_owner(places, [](void* p) noexcept { delete[] static_cast<std::int32_t*>(p); });
        for (std::size_t i = 0; i < count; ++i) {
            std::reverse_copy(bricks.places[i].begin(), bricks.places[i].end(), places + 3 * i);
        }
        auto* values = static_cast<float*>(bricks.values.release());
        const nb::capsule owner(values, [](void* p) noexcept { std::free(p); });
        return nb::make_tuple(info, nb::none(), PlaceArray(places, {count, 3}, places_owner), BrickArray(values, {count, EDGE, EDGE, EDGE}, owner));
    }
    if (extent.voxels > static_cast<double>(max_voxels)) {
        throw VdbError("the grid '" + grid->getName() + "' spans " + extent.text() + " voxels, more than the " + std::to_string(max_voxels) +
                       " that fit, and its bricks of " + std::to_string(EDGE) + "^3 that hold something do not fit either");
    }
    auto* values = new float[static_cast<std::size_t>(extent.voxels)];
    const nb::capsule owner(values, [](void* p) noexcept { delete[] static_cast<float*>(p); });
    {
        nb::gil_scoped_release release;
        openvdb::tools::Dense<float, openvdb::tools::LayoutXYZ> dense(box, values);
        openvdb::tools::copyToDense(*grid, dense);
    }
    return nb::make_tuple(info, DenseArray(values, {extent.n[2], extent.n[1], extent.n[0]}, owner), nb::none(), nb::none());
}

// A grid of three floats a voxel, cropped to its active voxels, as (description, dense array or None): z, y, x, component.
nb::tuple read_vectors(const std::string& path, std::size_t index, std::uint64_t max_voxels) {
    Reader reader(path);
    openvdb::GridBase::Ptr base;
    {
        nb::gil_scoped_release release;
        base = reader.load(index);
    }
    const auto grid = openvdb::gridPtrCast<openvdb::Vec3SGrid>(base);
    if (!grid) {
        throw VdbError("the grid '" + base->getName() + "' holds " + base->valueType() + " values, not vec3s");
    }
    const nb::dict info = describe(reader.at(index), *grid);
    const openvdb::CoordBBox box = grid->evalActiveVoxelBoundingBox();
    if (box.empty()) {
        return nb::make_tuple(info, nb::none());
    }
    const Extent extent(box);
    if (extent.voxels > static_cast<double>(max_voxels)) {
        throw VdbError("the grid '" + grid->getName() + "' spans " + extent.text() + " voxels, more than the " + std::to_string(max_voxels) +
                       " that fit");
    }
    static_assert(sizeof(openvdb::Vec3s) == 3 * sizeof(float));
    auto* values = new openvdb::Vec3s[static_cast<std::size_t>(extent.voxels)];
    const nb::capsule owner(values, [](void* p) noexcept { delete[] static_cast<openvdb::Vec3s*>(p); });
    {
        nb::gil_scoped_release release;
        openvdb::tools::Dense<openvdb::Vec3s, openvdb::tools::LayoutXYZ> dense(box, values);
        openvdb::tools::copyToDense(*grid, dense);
    }
    return nb::make_tuple(info, BrickArray(values->asPointer(), {extent.n[2], extent.n[1], extent.n[0], 3}, owner));
}

// An empty fog volume with its transform, name and metadata.
openvdb::FloatGrid::Ptr new_grid(const nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>& index_to_world,
                                 const std::string& name, bool half, const nb::dict& metadata) {
    openvdb::FloatGrid::Ptr grid = openvdb::FloatGrid::create(0.0f);
    grid->setName(name);
    grid->setGridClass(openvdb::GRID_FOG_VOLUME);
    grid->setSaveFloatAsHalf(half);
    for (const auto& [key, value] : metadata) {
        const auto k = nb::cast<std::string>(key);
        if (nb::isinstance<nb::bool_>(value)) {
            grid->insertMeta(k, openvdb::BoolMetadata(nb::cast<bool>(value)));
        } else if (nb::isinstance<nb::int_>(value)) {
            grid->insertMeta(k, openvdb::Int64Metadata(nb::cast<std::int64_t>(value)));
        } else if (nb::isinstance<nb::float_>(value)) {
            grid->insertMeta(k, openvdb::DoubleMetadata(nb::cast<double>(value)));
        } else {
            grid->insertMeta(k, openvdb::StringMetadata(nb::cast<std::string>(value)));
        }
    }
    openvdb::Mat4d m;
    for (int r = 0; r < 4; ++r) {
        for (int c = 0; c < 4; ++c) {
            m(c, r) = index_to_world(r, c);
        }
    }
    grid->setTransform(openvdb::math::Transform::createLinearTransform(m));
    return grid;
}

void write_grid(const std::string& path, const openvdb::FloatGrid::Ptr& grid, bool prune) {
    if (prune) {
        grid->pruneGrid();
    } else {
        grid->tree().voxelizeActiveTiles();
    }
    openvdb::io::File file(path);
    file.write({grid});
    file.close();
}

void write_dense(const std::string& path, const nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>& density,
                 const nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>& index_to_world, const std::string& name,
                 bool half, bool prune, const nb::dict& metadata) {
    const openvdb::FloatGrid::Ptr grid = new_grid(index_to_world, name, half, metadata);
    nb::gil_scoped_release release;
    const auto last = [](std::size_t n) { return static_cast<int>(n) - 1; };
    const openvdb::CoordBBox box({0, 0, 0}, {last(density.shape(2)), last(density.shape(1)), last(density.shape(0))});
    // Dense holds a pointer to mutable values but copyFromDense only reads them.
    const openvdb::tools::Dense<float, openvdb::tools::LayoutXYZ> dense(box, const_cast<float*>(density.data()));
    // Values equal to the background (0) stay inactive.
    openvdb::tools::copyFromDense(dense, *grid, 0.0f);
    write_grid(path, grid, prune);
}

// Bricks become leaves as they are: both have eight voxels along an edge.
void write_bricks(const std::string& path, const nb::ndarray<const std::int32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>& places,
                  const nb::ndarray<const float, nb::shape<-1, EDGE, EDGE, EDGE>, nb::c_contig, nb::device::cpu>& values,
                  const nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>& index_to_world, const std::string& name,
                  bool half, bool prune, const nb::dict& metadata) {
    const openvdb::FloatGrid::Ptr grid = new_grid(index_to_world, name, half, metadata);
    nb::gil_scoped_release release;
    for (std::size_t i = 0; i < places.shape(0); ++i) {
        const std::int32_t* const place = places.data() + 3 * i;
        auto* const leaf = grid->tree().touchLeaf(openvdb::Coord(EDGE * place[2], EDGE * place[1], EDGE * place[0]));
        const float* value = values.data() + i * BRICK;
        for (int z = 0; z < EDGE; ++z) {
            for (int y = 0; y < EDGE; ++y) {
                for (int x = 0; x < EDGE; ++x, ++value) {
                    if (*value != 0.0f) {
                        leaf->setValueOn(openvdb::Coord(x, y, z), *value);
                    }
                }
            }
        }
    }
    write_grid(path, grid, prune);
}

}  // namespace

NB_MODULE(_openvdb, m) {
    openvdb::initialize();
    nb::exception<VdbError>(m, "VdbError", PyExc_RuntimeError);
    // This translator is tried before the one that nb::exception registered: the text may hold bytes of a damaged file.
    nb::register_exception_translator(
        [](const std::exception_ptr& thrown, void* type) {
            const auto raise = [type](const std::string& message) {
                PyErr_SetObject(static_cast<PyObject*>(type), text(message).ptr());
            };
            try {
                std::rethrow_exception(thrown);
            } catch (const VdbError& error) {
                raise(error.what());
            } catch (const openvdb::Exception& error) {
                raise(error.what());
            } catch (const std::ios_base::failure&) {
                raise("the file ends too early or cannot be read or written");
            } catch (const std::length_error&) {
                raise("the file asks for an impossible amount of memory: it is damaged");
            }
        },
        m.attr("VdbError").ptr());
    m.attr("library_version") = std::string(openvdb::getLibraryVersionString());
    m.def("read_headers", &read_headers, nb::arg("path"));
    m.def("describe_grid", &describe_grid, nb::arg("path"), nb::arg("index"));
    m.def("count_bricks", &count_bricks, nb::arg("path"), nb::arg("index"), nb::arg("max_voxels"));
    m.def("read_floats", &read_floats, nb::arg("path"), nb::arg("index"), nb::arg("dense_voxels"), nb::arg("max_voxels"), nb::arg("max_box"));
    m.def("read_vectors", &read_vectors, nb::arg("path"), nb::arg("index"), nb::arg("max_voxels"));
    m.def("write_dense", &write_dense, nb::arg("path"), nb::arg("density"), nb::arg("index_to_world"), nb::arg("name"), nb::arg("half"),
          nb::arg("prune"), nb::arg("metadata"));
    m.def("write_bricks", &write_bricks, nb::arg("path"), nb::arg("places"), nb::arg("values"), nb::arg("index_to_world"), nb::arg("name"),
          nb::arg("half"), nb::arg("prune"), nb::arg("metadata"));
}
