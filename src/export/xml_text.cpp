#include "export/xml_text.hpp"

#include <algorithm>
#include <array>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

namespace {

constexpr const char* white_space = " \t\r\n";

std::string without_entities(std::string value) {
  static constexpr std::array<std::pair<const char*, char>, 5> entities = {
      {{"&lt;", '<'}, {"&gt;", '>'}, {"&quot;", '"'}, {"&apos;", '\''}, {"&amp;", '&'}}};
  for (const auto& [entity, character] : entities) {
    for (std::size_t at = value.find(entity); at != std::string::npos; at = value.find(entity, at + 1)) {
      value.replace(at, std::string_view(entity).size(), 1, character);
    }
  }
  return value;
}

}  // namespace

const XmlText::Attribute* XmlText::Element::attribute(std::string_view name) const {
  const auto found = std::find_if(attributes.begin(), attributes.end(), [&](const Attribute& one) { return one.name == name; });
  return found == attributes.end() ? nullptr : &*found;
}

XmlText::XmlText(std::string text, std::string file) : text_(std::move(text)), file_(std::move(file)) {
  std::vector<int> open = {-1};
  const auto starts = [this](std::size_t at, std::string_view mark) { return text_.compare(at, mark.size(), mark) == 0; };
  for (std::size_t at = text_.find('<'); at != std::string::npos; at = text_.find('<', at)) {
    if (starts(at, "<!--")) {
      at = behind("-->", at + 4);
    } else if (starts(at, "<![CDATA[")) {
      at = behind("]]>", at);
    } else if (starts(at, "<?")) {
      at = behind("?>", at);
    } else if (starts(at, "<!")) {
      // a document type may hold others in brackets
      const std::size_t bracket = text_.find('[', at);
      at = bracket < text_.find('>', at) ? behind(">", behind("]", at)) : behind(">", at);
    } else if (starts(at, "</")) {
      if (open.size() > 1) open.pop_back();
      at = behind(">", at);
    } else {
      at = read_element(at, open.back());
      if (!elements_.back().is_empty) open.push_back(static_cast<int>(elements_.size()) - 1);
    }
  }
}

// behind the next `mark`
std::size_t XmlText::behind(std::string_view mark, std::size_t from) const {
  const std::size_t at = text_.find(mark, from);
  if (at != std::string::npos) return at + mark.size();
  const auto line =
      std::count(text_.begin(), text_.begin() + static_cast<std::ptrdiff_t>(std::min(from, text_.size())), '\n') + 1;
  throw InputError(fmt::format("{}:{}: not XML ({} is missing); a robot is a MJCF or URDF file", file_, line, mark));
}

std::size_t XmlText::read_element(std::size_t at, int parent) {
  Element element;
  element.parent = parent;
  std::size_t end = std::min(text_.find_first_of(" \t\r\n/>", at), text_.size());
  element.tag = text_.substr(at + 1, end - at - 1);
  element.names_end = end;
  while (true) {
    const std::size_t next = text_.find_first_not_of(white_space, end);
    if (next == std::string::npos || text_[next] == '>' || text_[next] == '/') break;
    Attribute attribute;
    attribute.begin = end;
    const std::size_t equals = behind("=", next) - 1;
    attribute.name = text_.substr(next, equals - next);
    attribute.name.erase(attribute.name.find_last_not_of(white_space) + 1);
    const std::size_t quote = text_.find_first_not_of(white_space, equals + 1);
    if (quote == std::string::npos) static_cast<void>(behind("\"", text_.size()));
    attribute.value_begin = quote + 1;
    attribute.end = behind(std::string_view(text_).substr(quote, 1), quote + 1);
    attribute.value_end = attribute.end - 1;
    attribute.value = without_entities(text_.substr(attribute.value_begin, attribute.value_end - attribute.value_begin));
    end = element.names_end = attribute.end;
    element.attributes.push_back(std::move(attribute));
  }
  element.end = behind(">", end);
  element.is_empty = text_[element.end - 2] == '/';
  elements_.push_back(std::move(element));
  return elements_.back().end;
}

bool XmlText::is_within(const Element& element, std::string_view tag) const {
  for (int parent = element.parent; parent >= 0; parent = elements_[static_cast<std::size_t>(parent)].parent) {
    if (elements_[static_cast<std::size_t>(parent)].tag == tag) return true;
  }
  return false;
}

void XmlText::set(const Element& element, const std::string& name, const std::string& value) {
  if (const Attribute* const there = element.attribute(name)) {
    replace(there->value_begin, there->value_end, value);
  } else {
    insert(element.names_end, fmt::format(" {}=\"{}\"", name, value));
  }
}

void XmlText::remove(const Element& element, std::string_view name) {
  if (const Attribute* const there = element.attribute(name)) replace(there->begin, there->end, "");
}

std::string XmlText::changed() const {
  std::vector<Change> changes = changes_;
  // those at one place in the order in which they were made
  std::stable_sort(changes.begin(), changes.end(), [](const Change& a, const Change& b) { return a.begin < b.begin; });
  std::string out;
  std::size_t at = 0;
  for (const Change& change : changes) {
    out.append(text_, at, change.begin - at);
    out += change.text;
    at = change.end;
  }
  return out.append(text_, at);
}

}  // namespace gp2
