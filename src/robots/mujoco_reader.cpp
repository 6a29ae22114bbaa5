#include <array>
#include <memory>
#include <mutex>

#include <fmt/format.h>
#include <mujoco/mujoco.h>

#include "gp2/base/file.hpp"
#include "gp2/error.hpp"
#include "gp2/robots/robot.hpp"
#include "robots/mujoco_description.hpp"
#include "robots/mujoco_versions.hpp"
#include "robots/robot_checks.hpp"
#include "robots/robot_xml.hpp"

namespace gp2 {

namespace {

// ---- MuJoCo as a guest: it neither prints, nor exits, nor writes MUJOCO_LOG.TXT

// What MuJoCo says while this thread loads a file; null: it does not load one.
thread_local std::vector<std::string>* said = nullptr;

// MuJoCo's handlers belong to the process. Errors of the engine during compilation do not come here: mj_loadXML catches them
// itself. What is left comes from its C++ code, through which an exception passes.
class Handlers {
 public:
  explicit Handlers(std::vector<std::string>& warnings) : lock_(mutex()), error_(mju_user_error), warning_(mju_user_warning) {
    previous_warning() = warning_;
    said = &warnings;
    mju_user_error = [](const char* text) { throw InputError(text); };
    mju_user_warning = [](const char* text) {
      if (said != nullptr) {
        said->emplace_back(text);
      } else if (previous_warning() != nullptr) {
        previous_warning()(text);
      }
    };
  }
  ~Handlers() {
    mju_user_error = error_;
    mju_user_warning = warning_;
    said = nullptr;
  }
  Handlers(const Handlers&) = delete;
  Handlers& operator=(const Handlers&) = delete;

 private:
  using Handler = void (*)(const char*);

  static std::mutex& mutex() {
    static std::mutex one;
    return one;
  }
  static Handler& previous_warning() {
    static Handler handler = nullptr;
    return handler;
  }

  std::lock_guard<std::mutex> lock_;
  Handler error_;
  Handler warning_;
};

using ModelPointer = std::unique_ptr<mjModel, void (*)(mjModel*)>;

mujoco::Files in_memory(const std::string& name, const std::string& text) {
  auto* const empty = new mjVFS;
  mj_defaultVFS(empty);
  mujoco::Files files(empty);
  if (!mujoco::add_file(*files, name, text)) throw InputError(fmt::format("{}: MuJoCo does not take a file of this name", name));
  return files;
}

// MuJoCo's words in one line, without what they say where they know no line
std::string one_line(std::string text) {
  while (!text.empty() && text.back() == '\n') text.pop_back();
  for (const std::string prefix : {"Error: ", "XML Error: "}) {
    if (text.rfind(prefix, 0) == 0) text.erase(0, prefix.size());
  }
  for (std::size_t at = text.find('\n'); at != std::string::npos; at = text.find('\n')) text.replace(at, 1, "; ");
  return text.substr(0, text.find(", column = -1"));
}

// what to do about some of MuJoCo's refusals
std::string mend_of(const std::string& refusal) {
  struct Mend {
    const char* words;
    const char* mend;
  };
  static constexpr const char* missing =
      "The file of a mesh, height field or texture is missing: put it there, give its body an <inertial>, or remove the geom";
  static constexpr const char* newer =
      "Where it is no slip of the pen, the file is for another version of MuJoCo: build gp2 with that one (GP2_MUJOCO_DIR)";
  for (const Mend& known :
       {Mend{"larger than mjMINVAL", "A body that moves needs a mass and an inertia: give it <inertial> or a geom"},
        Mend{"A + B >= C", "No rigid body has such an inertia: correct it"},
        Mend{"free joint can only be used on top level",
             "A body that moves freely hangs on the world: in URDF name the parent link of its floating joint world, in MJCF "
             "put it straight into <worldbody>"},
        Mend{"Could not open", missing}, Mend{"could not open", missing}, Mend{"Error opening file", missing},
        Mend{"failed to open file", missing}, Mend{"but not `limited`", "From 3.0 on MuJoCo does the first of these by itself"},
        Mend{"unrecognized attribute", newer}, Mend{"unrecognized element", newer}, Mend{"invalid keyword", newer},
        Mend{"too much data", newer}}) {
    if (refusal.find(known.words) != std::string::npos) return fmt::format(". {}", known.mend);
  }
  return "";
}

struct Loaded {
  ModelPointer model = {nullptr, mj_deleteModel};
  std::string words;  // why it is refused, or a warning
};

/// @param text      what MuJoCo reads in place of the file; null: the file itself
/// @param warnings  what MuJoCo says to a file that it accepts
Loaded load(const std::filesystem::path& path, const std::string* text, std::vector<std::string>& warnings) {
  std::array<char, 4096> words = {};
  Loaded loaded;
  try {
    const Handlers handlers(warnings);
    const mujoco::Files files = text != nullptr ? in_memory(path.string(), *text) : nullptr;
    loaded.model.reset(mj_loadXML(path.c_str(), files.get(), words.data(), static_cast<int>(words.size())));
    mj_freeLastXML();
    loaded.words = one_line(words.data());
  } catch (const std::exception& error) {
    loaded.words = one_line(error.what());
  }
  // the lines would be those of the rewritten text
  if (!loaded.model && text != nullptr) {
    for (const char* place : {"; Element '", ", line = "}) loaded.words = loaded.words.substr(0, loaded.words.rfind(place));
  }
  return loaded;
}

// Where MuJoCo refuses a MJCF file, it is offered once more without the files that only give shapes.
/// @param in_place  whether the source is the file's own text, so that MuJoCo can read it where it lies
ModelPointer load(const std::filesystem::path& path, const std::string& source, bool in_place, const RobotXml& xml,
                  std::vector<std::string>& notes) {
  std::vector<std::string> warnings;
  Loaded loaded = load(path, xml.is_urdf ? &xml.text : in_place ? nullptr : &source, warnings);
  if (!loaded.model && !xml.is_urdf) {
    if (const auto bare = mjcf_without_shapes(source, path)) {
      warnings.clear();
      Loaded again = load(path, &*bare, warnings);
      if (again.model)
        notes.push_back(fmt::format("meshes, height fields and pictures are left out, since MuJoCo says: {}", loaded.words));
      // the first words have a line
      if (again.model || loaded.words.rfind(again.words, 0) != 0) loaded = std::move(again);
    }
  }
  if (!loaded.model) {
    throw InputError(
        fmt::format("{}: MuJoCo {} refuses it: {}{}", path.string(), mj_versionString(), loaded.words, mend_of(loaded.words)));
  }
  if (!loaded.words.empty()) warnings.push_back(loaded.words);
  for (const std::string& warning : warnings) notes.push_back(fmt::format("MuJoCo warns: {}", one_line(warning)));
  return std::move(loaded.model);
}

RobotDescription::Coupling coupling_of(const RobotXml::Mimic& mimic) {
  return {fmt::format("{} mimics {}", mimic.joint, mimic.followed),
          {{{mimic.joint, 1.0}}, {}, 0},
          {{{{mimic.followed, 1.0}}, {}, 0}},
          {mimic.offset, mimic.multiplier, 0, 0, 0}};
}

RobotDescription read(const std::filesystem::path& path, const std::string& source, bool in_place) {
  const RobotXml xml = read_robot_xml(source, path);
  std::vector<std::string> notes;
  const ModelPointer model = load(path, source, in_place, xml, notes);
  RobotDescription robot = describe(*model, mujoco::later_fields(*model), path.string());
  for (const RobotXml::Mimic& mimic : xml.mimics) robot.couplings.push_back(coupling_of(mimic));
  robot.notes.insert(robot.notes.end(), notes.begin(), notes.end());
  try {
    check_robot(robot);
  } catch (const InputError& error) {
    throw InputError(fmt::format("{}: {}", path.string(), error.what()));
  }
  return robot;
}

}  // namespace

bool can_read_robots() { return true; }

RobotDescription read_robot(const std::filesystem::path& path) { return read(path, read_file(path), true); }

RobotDescription read_robot(const std::filesystem::path& path, const std::string& text) { return read(path, text, false); }

}  // namespace gp2
