// Writes the .vdb files beside it, with OpenVDB alone, so that the reader is tested against files that our writer did not make.
// Build and run: g++ -std=c++17 make_fixtures.cpp -lopenvdb -ltbb -lImath -o make_fixtures && ./make_fixtures

#include <openvdb/openvdb.h>

#include <limits>

using namespace openvdb;

static FloatGrid::Ptr fog(const std::string& name, float background = 0.0f) {
    FloatGrid::Ptr grid = FloatGrid::create(background);
    grid->setName(name);
    grid->setGridClass(GRID_FOG_VOLUME);
    return grid;
}

static void save(const std::string& path, const GridPtrVec& grids) {
    io::File file(path);
    file.setCompression(io::COMPRESS_ZIP | io::COMPRESS_ACTIVE_MASK);
    file.write(grids);
}

int main() {
    initialize();

    // Tiles: 24 x 16 x 40 voxels of value 3 as active tiles of 8^3, and a single voxel apart from them.
    {
        FloatGrid::Ptr grid = fog("density");
        grid->sparseFill(CoordBBox({0, 0, 0}, {23, 15, 39}), 3.0f, true);
        grid->tree().setValue({-3, 5, 50}, 0.25f);
        grid->setTransform(math::Transform::createLinearTransform(0.5));
        save("tiles.vdb", {grid});
    }
    // Several grids: two float grids of which neither is called density, a vector grid, an integer grid, two of one name,
    // and one that shares its voxels with another.
    {
        FloatGrid::Ptr flames = fog("flames"), heat = fog("heat"), a = fog("twin"), b = fog("twin");
        flames->tree().setValue({1, 2, 3}, 1.0f);
        heat->tree().setValue({4, 5, 6}, 2.0f);
        a->tree().setValue({7, 8, 9}, 3.0f);
        b->tree().setValue({10, 11, 12}, 4.0f);
        FloatGrid::Ptr shared = flames->copy();  // the same tree
        shared->setTransform(math::Transform::createLinearTransform(2.0));
        shared->setName("shared");
        Vec3SGrid::Ptr wind = Vec3SGrid::create(Vec3s(0));
        wind->setName("wind");
        wind->tree().setValue({0, 0, 0}, Vec3s(1, 2, 3));
        Int32Grid::Ptr label = Int32Grid::create(0);
        label->setName("label");
        label->tree().setValue({0, 0, 0}, 5);
        save("several.vdb", {flames, heat, a, b, shared, wind, label});
    }
    // A cloud with an albedo on coarser voxels, as colours and as numbers: linear in the world's coordinates.
    {
        FloatGrid::Ptr density = fog("density"), grey = fog("grey");
        density->sparseFill(CoordBBox({0, 0, 0}, {15, 11, 7}), 1.0f, true);
        density->setTransform(math::Transform::createLinearTransform(0.125));
        Vec3SGrid::Ptr colour = Vec3SGrid::create(Vec3s(0));
        colour->setName("Cd");
        const math::Transform::Ptr coarse = math::Transform::createLinearTransform(0.25);
        for (int z = -1; z < 6; ++z) {
            for (int y = -1; y < 8; ++y) {
                for (int x = -1; x < 10; ++x) {
                    const Vec3d p = coarse->indexToWorld(Coord(x, y, z));
                    colour->tree().setValue({x, y, z}, Vec3s(0.2 + 0.3 * p.x(), 0.3 + 0.2 * p.y(), 0.5));
                    grey->tree().setValue({x, y, z}, 0.2 + 0.3 * p.x());
                }
            }
        }
        colour->setTransform(coarse);
        grey->setTransform(coarse->copy());
        save("painted.vdb", {density, colour, grey});
    }
    {
        FloatGrid::Ptr grid = fog("density");
        grid->tree().setValue({1, 1, 1}, 1.0f);
        grid->setTransform(math::Transform::createFrustumTransform(BBoxd({0, 0, 0}, {9, 9, 9}), 0.5, 2.0, 1.0));
        save("frustum.vdb", {grid});
    }
    {
        FloatGrid::Ptr grid = fog("density", 0.5f);
        grid->tree().setValue({1, 1, 1}, 1.0f);
        save("background.vdb", {grid});
    }
    {
        FloatGrid::Ptr grid = fog("surface", 3.0f);
        grid->setGridClass(GRID_LEVEL_SET);
        grid->tree().setValue({1, 1, 1}, -1.0f);
        save("level_set.vdb", {grid});
    }
    save("empty.vdb", {fog("density")});
    {
        FloatGrid::Ptr grid = fog("density");
        const float values[] = {2.0f, -1.0f, std::numeric_limits<float>::quiet_NaN(), -3.0f, 1.0f};
        for (int i = 0; i < 5; ++i) grid->tree().setValue({i, 0, 0}, values[i]);
        save("no_density.vdb", {grid});
    }
    // Rotated, non-uniform, translated; stored with 16 bits.
    {
        FloatGrid::Ptr grid = fog("density");
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 2; ++j)
                for (int k = 0; k < 4; ++k) grid->tree().setValue({i + 5, j - 2, k + 1}, 1.0f + i + 10.0f * j + 100.0f * k);
        grid->setSaveFloatAsHalf(true);
        math::Transform::Ptr t = math::Transform::createLinearTransform(1.0);
        t->preScale(Vec3d(0.5, 1.0, 2.0));
        t->postRotate(0.5, math::Z_AXIS);
        t->postTranslate(Vec3d(10, 20, 30));
        grid->setTransform(t);
        save("rotated.vdb", {grid});
    }
    // A fire: smoke, flames as vectors, a temperature that is no Kelvin, and a wind.
    {
        FloatGrid::Ptr smoke = fog("density"), temperature = fog("temperature");
        Vec3SGrid::Ptr flames = Vec3SGrid::create(Vec3s(0));
        flames->setName("FlameColour");
        flames->tree().setValue({1, 1, 1}, Vec3s(3, 2, 1));
        Vec3SGrid::Ptr wind = Vec3SGrid::create(Vec3s(0));
        wind->setName("wind");
        wind->tree().setValue({1, 1, 1}, Vec3s(3, 2, 1));
        smoke->fill(CoordBBox({0, 0, 0}, {7, 7, 7}), 1.0f);
        for (int i = 0; i < 8; ++i) temperature->tree().setValue({i, 0, 0}, 0.25f * i);
        save("fire.vdb", {smoke, temperature, flames, wind});
    }
    // A cloud out of a weather model, with grids of a fire's names that give no light.
    {
        FloatGrid::Ptr cloud = fog("density"), temperature = fog("temperature"), ambient = fog("heat"), burn = fog("burn"), flames = fog("flames");
        cloud->fill(CoordBBox({0, 0, 0}, {7, 7, 7}), 1.0f);
        for (int i = 0; i < 8; ++i) temperature->tree().setValue({i, i, 0}, 250.0f + 5 * i);
        ambient->fill(CoordBBox({0, 0, 0}, {7, 7, 7}), 1.0f);
        burn->fill(CoordBBox({0, 0, 0}, {7, 7, 7}), 0.0f);
        save("weather.vdb", {cloud, temperature, ambient, burn, flames});
    }
    // A grid type that only a program which registers it can read.
    {
        using Odd = tree::Tree4<float, 5, 4, 2>::Type;
        Grid<Odd>::registerGrid();
        Grid<Odd>::Ptr odd = Grid<Odd>::create(0.0f);
        odd->setName("odd");
        odd->tree().setValue({0, 0, 0}, 1.0f);
        FloatGrid::Ptr grid = fog("density");
        grid->tree().setValue({1, 2, 3}, 7.0f);
        save("unknown_type.vdb", {odd, grid});
    }
}
