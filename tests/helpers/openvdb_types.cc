// Wrote tests/data/openvdb.zip with OpenVDB 10.0.1 (apt install libopenvdb-dev libboost-dev):
//   g++ -w openvdb_types.cc -lopenvdb -ltbb -lImath-3_1 && ./a.out FOLDER
// A grid of each type in each packing: cells of a leaf, inactive ones of another value than the
// background, and a tile at each level. tests/files/grids/test_vdb_tiles.py knows what is active.
#include <openvdb/openvdb.h>

using namespace openvdb;

template <class Grid>
void write(const std::string& path, uint32_t packing, bool half)
{
    using Value = typename Grid::ValueType;
    const Value one(1), other(2);
    auto grid = Grid::create(Value(0));
    auto cells = grid->getAccessor();
    for (int i = 0; i < 300; i++) cells.setValue(Coord(i % 7, i * i % 13, i * 7 % 11), one);
    cells.setValueOff(Coord(3, 3, 3), other);
    cells.setValueOff(Coord(100, 3, 3), other);
    cells.setValue(Coord(101, 3, 3), one);
    cells.setValue(Coord(102, 3, 3), one);
    auto& tree = grid->tree();
    tree.addTile(1, Coord(16, 0, 0), one, true);  // 8 cells a side
    tree.addTile(1, Coord(24, 0, 0), other, false);
    tree.addTile(2, Coord(128, 0, 0), one, true);  // 128
    tree.addTile(3, Coord(-4096, 0, 0), one, true);  // 4096
    grid->setName("a");
    grid->setSaveFloatAsHalf(half);
    grid->setTransform(math::Transform::createLinearTransform(0.5));
    io::File file(path);
    file.setCompression(packing);
    file.write(GridPtrVec{grid});
}

int main(int, char** arguments)
{
    initialize();
    const std::pair<const char*, uint32_t> packings[] = {
        {"none", 0}, {"zip", io::COMPRESS_ZIP | io::COMPRESS_ACTIVE_MASK},
        {"blosc", io::COMPRESS_BLOSC | io::COMPRESS_ACTIVE_MASK}};
    for (const auto& [name, packing] : packings) {
        const std::string folder = std::string(arguments[1]) + "/", end = std::string(" ") + name;
        write<FloatGrid>(folder + "float" + end + ".vdb", packing, false);
        write<FloatGrid>(folder + "float" + end + " half.vdb", packing, true);
        write<DoubleGrid>(folder + "double" + end + ".vdb", packing, false);
        write<DoubleGrid>(folder + "double" + end + " half.vdb", packing, true);
        write<Int32Grid>(folder + "int32" + end + ".vdb", packing, false);
        write<Int64Grid>(folder + "int64" + end + ".vdb", packing, false);
        write<BoolGrid>(folder + "bool" + end + ".vdb", packing, false);
    }
}
