#pragma once

#include <cstddef>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace gp2 {

/// Where elements and attributes stand in a XML text, so that some can be changed and every other byte stays.
class XmlText {
 public:
  struct Attribute {
    std::string name;
    std::string value;                           // entities replaced
    std::size_t begin = 0, end = 0;              // with the white space before it, to behind the closing quote
    std::size_t value_begin = 0, value_end = 0;  // between the quotes
  };
  struct Element {
    std::string tag;
    int parent = -1;
    std::vector<Attribute> attributes;
    std::size_t names_end = 0;  // behind the last attribute, or the tag's name
    std::size_t end = 0;        // behind the > of its start tag
    bool is_empty = false;      // <tag/>

    /// Null where there is none.
    [[nodiscard]] const Attribute* attribute(std::string_view name) const;
  };

  /// @param file  for messages
  /// @throws InputError where a tag, a comment or a value has no end.
  XmlText(std::string text, std::string file);

  [[nodiscard]] const std::string& text() const { return text_; }
  [[nodiscard]] const std::vector<Element>& elements() const { return elements_; }
  [[nodiscard]] bool is_within(const Element& element, std::string_view tag) const;

  // Changes, which `changed` makes all at once; none may overlap another.
  void set(const Element& element, const std::string& name, const std::string& value);
  void remove(const Element& element, std::string_view name);
  void insert(std::size_t at, std::string text) { changes_.push_back({at, at, std::move(text)}); }
  void replace(std::size_t begin, std::size_t end, std::string text) { changes_.push_back({begin, end, std::move(text)}); }
  [[nodiscard]] std::string changed() const;

 private:
  struct Change {
    std::size_t begin, end;
    std::string text;
  };

  [[nodiscard]] std::size_t behind(std::string_view mark, std::size_t from) const;
  std::size_t read_element(std::size_t at, int parent);

  std::string text_, file_;
  std::vector<Element> elements_;
  std::vector<Change> changes_;
};

}  // namespace gp2
