function example_patch(link)
% EXAMPLE_PATCH  A patch of colour, whose hue (degrees) and light (%) a hilbo session chooses; in MATLAB or Octave.
%
%   hilbo init colour.toml --name colour --parameter hue=140:260:deg --parameter light=20:80:%
%   hilbo session colour.toml --participant P01 --dry-run          % in a terminal: prints the links
%   example_patch('LINK-OF-THE-STIMULUS')                          % here; Ctrl-C ends
%
% In a figure's window, or, without a screen, in the terminal. The reference is a patch of a hidden colour.

  reference = containers.Map({'hue', 'light'}, {205, 45});
  stimulus = hilbo_stimulus(link, 'example_patch.m', '1', 'neutral_within_s', 0.5);
  ends = onCleanup(@() stimulus.close());
  draw = screen();
  while true
    order = stimulus.next(0.5);
    if isempty(order)
      continue
    end
    if ~strcmp(order.what, 'present')
      draw('', []);
      stimulus.neutral();
    elseif strcmp(order.show, 'reference')
      draw('Reference', colour(reference));
      stimulus.presented();
    elseif ~isKey(order.values, 'hue') || ~isKey(order.values, 'light')
      stimulus.failed('this patch has hue and light');
    else
      draw('Test', colour(order.values));
      stimulus.presented(order.values);  % the values really presented: here, the requested ones
    end
  end
end

function draw = screen()
% A function of a title and a colour (red, green, blue from 0 to 1; [] for nothing), which shows both.
  if usejava('desktop') || (exist('OCTAVE_VERSION', 'builtin') && ~isempty(getenv('DISPLAY')))
    window = figure('Name', 'hilbo', 'NumberTitle', 'off', 'MenuBar', 'none', 'Color', 'w');
    draw = @(title, rgb) in_figure(window, title, rgb);
  else
    draw = @in_terminal;
  end
end

function in_figure(window, title, rgb)
  if isempty(rgb), rgb = [1 1 1]; end
  set(window, 'Name', title, 'Color', rgb);
  drawnow();
end

function in_terminal(title, rgb)
  fprintf('%s[2J%s[H%s\n', char(27), char(27), title);
  for row = 1:12 * ~isempty(rgb)
    fprintf('%s[48;2;%d;%d;%dm%s%s[0m\n', char(27), round(255 * rgb), blanks(40), char(27));
  end
  if exist('OCTAVE_VERSION', 'builtin'), fflush(stdout()); end
end

function rgb = colour(values)
% Red, green, blue of a hue and a light, at a saturation of 0.7.
  light = values('light') / 100;
  k = mod([0 8 4] + values('hue') / 30, 12);
  rgb = light - 0.7 * min(light, 1 - light) * max(-1, min(min(k - 3, 9 - k), 1));
end
