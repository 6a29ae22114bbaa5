#pragma once

#include <memory>
#include <optional>
#include <tuple>
#include <type_traits>
#include <vector>

#include <pybind11/eigen.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

namespace gp2::python {

namespace py = pybind11;

// Results as plain values, for pickle and copies. The state of a struct is the tuple of its fields, which an overload of
//
//     auto fields(T& one) { return std::tie(one.field, …); }
//
// lists; these may be structs themselves, optional, or in vectors.
template <typename T>
concept Struct = requires(T& one) {
  fields(one);
};

template <typename T>
struct StateOf {
  static py::object get(const T& value) {
    if constexpr (Struct<T>) {
      const auto of_fields = [](const auto&... field) {
        return py::make_tuple(StateOf<std::remove_cvref_t<decltype(field)>>::get(field)...);
      };
      return std::apply(of_fields, fields(const_cast<T&>(value)));  // which are only read here
    } else if constexpr (std::is_enum_v<T>) {
      return py::int_(static_cast<int>(value));
    } else if constexpr (std::is_base_of_v<py::object, T>) {
      return value;
    } else {
      return py::cast(value);
    }
  }

  static void set(T& value, const py::object& state) {
    if constexpr (Struct<T>) {
      std::size_t k = 0;
      const py::tuple states = state;
      const auto set_fields = [&](auto&... field) {
        (StateOf<std::remove_cvref_t<decltype(field)>>::set(field, states[k++]), ...);
      };
      std::apply(set_fields, fields(value));
    } else if constexpr (std::is_enum_v<T>) {
      value = static_cast<T>(state.cast<int>());
    } else {
      value = state.cast<T>();
    }
  }
};

template <Struct T>
struct StateOf<std::optional<T>> {
  static py::object get(const std::optional<T>& value) { return value ? StateOf<T>::get(*value) : py::none(); }
  static void set(std::optional<T>& value, const py::object& state) {
    value.reset();
    if (!state.is_none()) StateOf<T>::set(value.emplace(), state);
  }
};

template <Struct T>
struct StateOf<std::vector<T>> {
  static py::object get(const std::vector<T>& values) {
    py::list states;
    for (const T& value : values) states.append(StateOf<T>::get(value));
    return states;
  }
  static void set(std::vector<T>& values, const py::object& states) {
    values.clear();
    for (const py::handle state : states) StateOf<T>::set(values.emplace_back(), py::reinterpret_borrow<py::object>(state));
  }
};

/// For py::class_<T>::def.
template <Struct T>
auto pickled() {
  return py::pickle([](const T& value) { return py::tuple(StateOf<T>::get(value)); },
                    [](const py::tuple& state) {
                      T value;
                      StateOf<T>::set(value, state);
                      return value;
                    });
}

}  // namespace gp2::python
