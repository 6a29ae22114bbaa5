#include "robots/robot_xml.hpp"

#include <algorithm>
#include <array>
#include <cctype>
#include <charconv>
#include <initializer_list>
#include <iterator>
#include <locale>
#include <map>
#include <optional>
#include <set>
#include <sstream>
#include <string_view>
#include <vector>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <boost/property_tree/ptree.hpp>
#include <boost/property_tree/xml_parser.hpp>

#include "gp2/base/file.hpp"
#include "gp2/error.hpp"

namespace gp2 {

using Tree = boost::property_tree::ptree;

namespace {

// Elements within elements: the parser calls itself for each, and a real file has a dozen. Comments may hold tags that are never
// closed, which this counts too.
void check_depth(std::string_view text, const std::string& name) {
  constexpr int deepest = 1000;
  int depth = 0;
  for (std::size_t k = 0; k + 1 < text.size(); ++k) {
    if (text[k] == '<' && std::isalpha(static_cast<unsigned char>(text[k + 1])) != 0) ++depth;
    if ((text[k] == '<' && text[k + 1] == '/') || (text[k] == '/' && text[k + 1] == '>')) --depth;
    if (depth > deepest) throw InputError(fmt::format("{}: elements are nested more than {} deep", name, deepest));
  }
}

Tree parse(const std::string& text, const std::string& name) {
  check_depth(text, name);
  Tree tree;
  std::istringstream stream(text);
  try {
    read_xml(stream, tree, boost::property_tree::xml_parser::no_comments | boost::property_tree::xml_parser::trim_whitespace);
  } catch (const boost::property_tree::xml_parser_error& error) {
    throw InputError(fmt::format("{}:{}: not XML ({}); a robot is a MJCF or URDF file", name, error.line(), error.message()));
  }
  return tree;
}

std::optional<std::string> attribute(const Tree& element, const char* name) {
  const auto value = element.get_optional<std::string>(Tree::path_type(fmt::format("<xmlattr>|{}", name), '|'));
  return value ? std::optional(*value) : std::nullopt;
}

// Checks of a <robot> and its changes; `name` is the file's.
class Urdf {
 public:
  Urdf(Tree& robot, std::string name) : robot_(robot), name_(std::move(name)) {}

  RobotXml prepared() {
    const auto compiler = robot_.get_child_optional("mujoco.compiler");
    inertia_is_of_shapes_ = compiler && attribute(*compiler, "inertiafromgeom") == "true";
    for (auto& [tag, element] : robot_) {
      if (tag.rfind("xacro:", 0) == 0) fail(fmt::format("<{}> is of xacro: expand it first with: xacro FILE > robot.urdf", tag));
      if (tag == "link") check_link(element);
    }
    if (links_.empty()) fail("it has no <link>");
    RobotXml xml;
    xml.is_urdf = true;
    for (const auto& [tag, element] : robot_) {
      if (tag == "joint") check_joint(element, xml.mimics);
    }
    for (const RobotXml::Mimic& mimic : xml.mimics) check_mimic(mimic);
    check_tree();
    keep_fixed_links();
    return xml;
  }

 private:
  [[noreturn]] void fail(const std::string& what) const { throw InputError(fmt::format("{}: {}", name_, what)); }

  [[nodiscard]] std::string name_of(const Tree& element, const char* tag) const {
    const auto name = attribute(element, "name");
    if (!name || name->empty()) fail(fmt::format("a <{}> has no name", tag));
    return *name;
  }

  // The element of this tag; null: there is none.
  [[nodiscard]] const Tree* only(const Tree& parent, const char* tag, const std::string& where) const {
    if (parent.count(tag) > 1) fail(fmt::format("{}: its <{}> stands twice: remove one", where, tag));
    const auto found = parent.find(tag);
    return found == parent.not_found() ? nullptr : &found->second;
  }

  static bool is_number(std::string_view word) {
    if (word.starts_with('+')) word.remove_prefix(1);
    const char* const end = word.data() + word.size();
    double value = 0;
    const auto [stop, error] = std::from_chars(word.data(), end, value);
    return stop == end && error != std::errc::invalid_argument;
  }

  // An attribute of so many numbers. MuJoCo refuses others too, but does not say of which link or joint they are.
  struct Numbers {
    const char *tag, *name;
    std::size_t n;
    bool is_required;  // where the element is there
  };

  void check_numbers(const Tree& parent, std::initializer_list<Numbers> all, const std::string& where) const {
    for (const auto& [tag, name, n, is_required] : all) {
      const Tree* const element = only(parent, tag, where);
      const auto text = element != nullptr ? attribute(*element, name) : std::nullopt;
      if (element != nullptr && !text && is_required) fail(fmt::format("{}: its <{}> has no {}", where, tag, name));
      if (!text) continue;
      std::istringstream stream(*text);
      const std::vector<std::string> words{std::istream_iterator<std::string>(stream), {}};
      if (words.size() == n && std::all_of(words.begin(), words.end(), is_number)) continue;
      fail(fmt::format("{}: {} of its <{}> must be {}, got '{}'", where, name, tag,
                       n == 1 ? "a number" : fmt::format("{} numbers with spaces between", n), *text));
    }
  }

  void check_origin(const Tree& parent, const std::string& where) const {
    check_numbers(parent, {{"origin", "xyz", 3, false}, {"origin", "rpy", 3, false}}, where);
  }

  [[nodiscard]] double number(const std::optional<std::string>& text, const std::string& where, const char* what) const {
    double value = 0;
    std::istringstream stream(text.value_or(""));
    stream.imbue(std::locale::classic());
    if (!(stream >> value) || !(stream >> std::ws).eof()) {
      fail(fmt::format("{}: {} must be a number, got '{}'", where, what, text.value_or("")));
    }
    return value;
  }

  void check_link(Tree& link) {
    const std::string where = fmt::format("link '{}'", name_of(link, "link"));
    if (!links_.insert(name_of(link, "link")).second) fail(fmt::format("{}: it stands twice", where));
    const Tree* const inertial = only(link, "inertial", where);
    if (inertial != nullptr) check_inertial(*inertial, where);

    // shapes only matter where they stand in for an inertia
    if (inertial != nullptr && !inertia_is_of_shapes_) {
      link.erase("visual");
      link.erase("collision");
    }
    for (const auto& [tag, element] : link) {
      if (tag == "collision") check_shape(element, fmt::format("{}, <collision>", where));
    }
  }

  void check_inertial(const Tree& inertial, const std::string& where) const {
    const std::string within = fmt::format("{}, <inertial>", where);
    const Tree* const mass = only(inertial, "mass", within);
    if (mass == nullptr) fail(fmt::format("{}: its <inertial> has no <mass>", where));
    const double value = number(attribute(*mass, "value"), where, "its mass");
    if (!(value >= 0)) fail(fmt::format("{}: its mass must be ≥ 0 kg, got {}", where, value));
    if (only(inertial, "inertia", within) == nullptr) fail(fmt::format("{}: its <inertial> has no <inertia>", where));
    for (const char* entry : {"ixx", "iyy", "izz", "ixy", "ixz", "iyz"}) {
      check_numbers(inertial, {{"inertia", entry, 1, true}}, within);
    }
    check_origin(inertial, within);
  }

  void check_shape(const Tree& shape, const std::string& where) const {
    check_origin(shape, where);
    const Tree* const geometry = only(shape, "geometry", where);
    if (geometry == nullptr) fail(fmt::format("{}: it has no <geometry>", where));
    check_numbers(*geometry,
                  {{"box", "size", 3, true},
                   {"sphere", "radius", 1, true},
                   {"cylinder", "radius", 1, true},
                   {"cylinder", "length", 1, true}},
                  where);
  }

  [[nodiscard]] std::string link_of(const Tree& joint, const char* end, const std::string& where) const {
    const Tree* const child = only(joint, end, where);
    const auto link = child != nullptr ? attribute(*child, "link") : std::nullopt;
    if (!link) fail(fmt::format("{}: it has no <{} link=\"…\"/>", where, end));
    if (links_.count(*link) == 0) {
      fail(fmt::format("{}: its {} link '{}' is not in the file; add <link name=\"{}\"> or correct the name", where, end, *link,
                       *link));
    }
    return *link;
  }

  void check_joint(const Tree& joint, std::vector<RobotXml::Mimic>& mimics) {
    static constexpr std::array<const char*, 6> types = {"revolute", "continuous", "prismatic", "fixed", "floating", "planar"};
    const std::string name = name_of(joint, "joint");
    const std::string where = fmt::format("joint '{}'", name);
    const std::string type = attribute(joint, "type").value_or("");
    if (!types_.emplace(name, type).second) fail(fmt::format("{}: it stands twice", where));
    if (std::find(types.begin(), types.end(), type) == types.end()) {
      fail(fmt::format("{}: its type is '{}'; there is: {}", where, type, fmt::join(types, ", ")));
    }
    const std::string parent = link_of(joint, "parent", where);
    const std::string child = link_of(joint, "child", where);
    if (!parents_.emplace(child, parent).second) {
      fail(fmt::format("link '{}': it is the child of two joints; a loop is closed in MJCF, with <equality><connect>", child));
    }
    check_origin(joint, where);
    check_numbers(joint, {{"axis", "xyz", 3, true}}, where);
    // MuJoCo does not read these of a joint that cannot move
    if (type != "fixed") {
      for (const char* limit : {"lower", "upper", "effort"}) {
        check_numbers(joint, {{"limit", limit, 1, false}}, where);
      }
      check_numbers(joint, {{"dynamics", "damping", 1, false}, {"dynamics", "friction", 1, false}}, where);
    }
    if (const Tree* const mimic = only(joint, "mimic", where)) {
      const auto followed = attribute(*mimic, "joint");
      if (!followed) fail(fmt::format("{}: its <mimic> names no joint", where));
      const double multiplier = number(attribute(*mimic, "multiplier").value_or("1"), where, "the multiplier of its <mimic>");
      const double offset = number(attribute(*mimic, "offset").value_or("0"), where, "the offset of its <mimic>");
      mimics.push_back({name, *followed, multiplier, offset});
    }
  }

  void check_mimic(const RobotXml::Mimic& mimic) const {
    const auto& [joint, followed, multiplier, offset] = mimic;
    if (types_.count(followed) == 0) {
      fail(fmt::format("joint '{}': it mimics '{}', which is no joint of the file", joint, followed));
    }
    if (joint == followed) fail(fmt::format("joint '{}': it mimics itself; name another joint or remove the <mimic>", joint));
    for (const std::string& either : {joint, followed}) {
      const std::string& type = types_.at(either);
      if (type != "fixed" && type != "floating" && type != "planar") continue;
      fail(
          fmt::format("joint '{}': it mimics '{}', but the type of '{}' is {}: only revolute, continuous and prismatic joints "
                      "mimic or are mimicked",
                      joint, followed, either, type));
    }
  }

  // every link hangs, by way of its parents, on the one that has none
  void check_tree() const {
    std::vector<std::string> roots;
    std::copy_if(links_.begin(), links_.end(), std::back_inserter(roots),
                 [&](const std::string& link) { return !parents_.contains(link); });
    if (roots.size() > 1) {
      fail(
          fmt::format("no joint has the links {} as its child; a URDF has one root: join the others by a <joint>, with "
                      "type=\"fixed\" where they do not move, or remove them",
                      fmt::join(roots, ", ")));
    }
    std::set<std::string> hangs;
    for (const std::string& link : links_) {
      std::set<std::string> path;
      for (auto step = parents_.find(link); step != parents_.end() && hangs.count(step->first) == 0;
           step = parents_.find(step->second)) {
        if (!path.insert(step->first).second) fail(fmt::format("link '{}': it is its own ancestor", step->first));
      }
      hangs.merge(path);
    }
  }

  void keep_fixed_links() {
    if (!robot_.get_child_optional("mujoco")) robot_.push_front({"mujoco", Tree()});
    Tree& mujoco = robot_.get_child("mujoco");
    if (!mujoco.get_child_optional("compiler")) mujoco.push_front({"compiler", Tree()});
    Tree& compiler = mujoco.get_child("compiler");
    if (!attribute(compiler, "fusestatic")) compiler.put("<xmlattr>.fusestatic", "false");
  }

  Tree& robot_;
  std::string name_;
  bool inertia_is_of_shapes_ = false;  // for a link that has its own, too
  std::set<std::string> links_;
  std::map<std::string, std::string> types_;    // of a joint by its name
  std::map<std::string, std::string> parents_;  // of a link by its name
};

// A <mujoco> without the files that only give shapes and colours.
class Mjcf {
 public:
  Mjcf(Tree& root, const std::filesystem::path& path) : root_(root), folder_(path.parent_path()) {
    included_.insert(path.filename());
    include(root_, folder_);
  }

  /// Whether there was anything to leave out.
  bool drop_shapes() {
    for (const auto& [tag, element] : root_) {
      if (tag == "compiler" && attribute(element, "inertiafromgeom") == "true") return false;
    }
    for (auto& [tag, element] : root_) {
      if (tag == "worldbody") drop_shapes_in(element, true);
    }
    for (const auto& [tag, element] : root_) {
      if (tag != "asset") note_shapes_used(element);
    }
    for (auto& [tag, element] : root_) {
      if (tag == "asset") drop_assets(element);
      if (tag == "deformable") changed_ |= element.erase("skin") > 0;
    }
    return changed_;
  }

 private:
  static void remove_attribute(Tree& element, const char* name) {
    if (const auto attributes = element.get_child_optional("<xmlattr>")) attributes->erase(name);
  }
  static void set_attribute(Tree& element, const char* name, const std::string& value) {
    element.put(Tree::path_type(fmt::format("<xmlattr>|{}", name), '|'), value);
  }

  // MuJoCo takes files from the folder of the first one; later versions also from that of the including one.
  void include(Tree& element, const std::filesystem::path& folder) {
    for (auto child = element.begin(); child != element.end();) {
      if (child->first != "include") {
        include(child->second, folder);
        ++child;
        continue;
      }
      const std::string name = attribute(child->second, "file").value_or("");
      std::filesystem::path path = folder_ / name;
      if (!std::filesystem::exists(path)) path = folder / name;
      if (!included_.insert(path).second) throw InputError(fmt::format("{}: it is included twice", path.string()));
      Tree other = parse(read_file(path), path.string());
      child = element.erase(child);
      if (other.empty()) continue;
      include(other.front().second, path.parent_path());
      for (auto& added : other.front().second) {
        if (added.first != "<xmlattr>") child = std::next(element.insert(child, added));
      }
    }
  }

  void drop_shapes_in(Tree& element, bool has_inertia) {
    for (auto& [tag, child] : element) {
      if (tag == "body") {
        drop_shapes_in(child, child.get_child_optional("inertial").has_value());
      } else if (tag != "geom") {
        drop_shapes_in(child, has_inertia);
      } else if (has_inertia && (attribute(child, "mesh") || attribute(child, "hfield"))) {
        // the geom stays, since others may name it
        for (const char* name : {"mesh", "hfield", "fitscale"}) remove_attribute(child, name);
        set_attribute(child, "type", "sphere");
        set_attribute(child, "size", "0.001");
        changed_ = true;
      }
    }
  }

  void note_shapes_used(const Tree& element) {
    for (const auto& [tag, child] : element) {
      for (const char* kind : {"mesh", "hfield"}) {
        if (const auto name = attribute(child, kind)) used_.insert(*name);
      }
      note_shapes_used(child);
    }
  }

  void drop_assets(Tree& assets) {
    for (auto asset = assets.begin(); asset != assets.end();) {
      auto& [tag, element] = *asset;
      const std::string file = attribute(element, "file").value_or("");
      const std::string name = attribute(element, "name").value_or(std::filesystem::path(file).stem().string());
      const bool is_unused = tag == "skin" || ((tag == "mesh" || tag == "hfield") && used_.count(name) == 0);
      if (is_unused) {
        asset = assets.erase(asset);
        changed_ = true;
        continue;
      }
      if (tag == "texture") drop_picture(element, name);
      ++asset;
    }
  }

  void drop_picture(Tree& texture, const std::string& name) {
    static constexpr std::array<const char*, 7> files = {"file",     "fileright", "fileleft", "fileup",
                                                         "filedown", "filefront", "fileback"};
    if (std::none_of(files.begin(), files.end(), [&](const char* file) { return attribute(texture, file).has_value(); })) return;
    for (const char* file : files) remove_attribute(texture, file);
    for (const char* other : {"gridsize", "gridlayout", "content_type"}) remove_attribute(texture, other);
    set_attribute(texture, "name", name);
    set_attribute(texture, "builtin", "flat");
    set_attribute(texture, "width", "1");
    set_attribute(texture, "height", "1");
    changed_ = true;
  }

  Tree& root_;
  std::filesystem::path folder_;
  std::set<std::filesystem::path> included_;
  std::set<std::string> used_;  // meshes and height fields that something still has
  bool changed_ = false;
};

std::string text_of(const Tree& tree) {
  std::ostringstream stream;
  write_xml(stream, tree);
  return stream.str();
}

}  // namespace

RobotXml read_robot_xml(const std::string& text, const std::filesystem::path& path) {
  Tree tree = parse(text, path.string());
  if (tree.get_child_optional("mujoco")) return {};
  const auto robot = tree.get_child_optional("robot");
  if (!robot) {
    const std::string root = tree.empty() ? ", but it is empty" : fmt::format(", but it starts with <{}>", tree.front().first);
    throw InputError(fmt::format("{}: a robot is a MJCF file (<mujoco>) or a URDF file (<robot>){}", path.string(), root));
  }
  RobotXml xml = Urdf(*robot, path.string()).prepared();
  xml.text = text_of(tree);
  return xml;
}

std::optional<std::string> mjcf_without_shapes(const std::string& text, const std::filesystem::path& path) {
  Tree tree = parse(text, path.string());
  const auto root = tree.get_child_optional("mujoco");
  if (!root || !Mjcf(*root, path).drop_shapes()) return std::nullopt;
  return text_of(tree);
}

}  // namespace gp2
